"""Run SLAM in real time for a long time, and test whether latency, memory, files or dropped frames grow (issue 20).

All cores render one round through a synthetic room first. Then a fresh process replays it again and again at 30 Hz, as
`sigmasplat run --realtime` does, with log, saved states and submaps on disk. Ctrl-C ends it, and the run folder is read
back. Figures are taken for each minute. The slope of each figure is tested: over the whole run it must not grow by
more than a share of its median. Writes benchmarks/results/long-live-<machine>.json and prints tables. Linux only.

example: python benchmarks/long_live.py --quick
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from cpu import alone
from cpu_scene import peak_mib
from long_run import draw_all, kept, resident_mib
from scipy.stats import theilslopes
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import color_from_bytes
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.callbacks import Callback
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.slam.results import Step

arg = tyro.conf.arg
SOURCE = "synthetic:frames=900,rooms=2,noise=1,width=640,height=480"
"""A closed path of half a minute, so that the last frame is beside the first one."""
QUICK_SOURCE, QUICK_SETTING = "synthetic:frames=450,noise=1,width=160,height=120", "input.width=160"
FRAMES_PER_SECOND = 30.0
SAMPLES_EVERY_S = 1.0
SETTLING_MINUTES = 1
"""The first minute is left out of the slopes: libraries are loaded, and memory grows to its usual size."""


@dataclass(frozen=True)
class Options:
    """Run SLAM in real time for a long time, and test whether latency, memory, files or dropped frames grow."""

    minutes: Annotated[float, arg(help="length of the run")] = 30.0
    source: Annotated[str, arg(help="sequence that ends where it begins; it is repeated")] = SOURCE
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    seed: int = 0
    save_every: Annotated[float, arg(help="seconds between saves of the state, 0 = none")] = 60.0
    quick: Annotated[bool, arg(help="three minutes of small frames, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "long-live"
    scratch: Annotated[Path, arg(help="folder for frames and run, removed afterwards: 10 GB")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self) -> Config:
        """Return the run's settings. Raises ConfigError for an unknown preset or setting."""
        return override(preset_of(self.preset), split_settings(self.settings) | {"seed": str(self.seed)})


class Repeated(Source):
    """A drawn sequence, repeated for a number of frames; its times go on."""

    def __init__(self, whole: Source, folder: Path, frames: int) -> None:
        super().__init__(whole.name, whole.camera)
        self._folder, self._frames, self._round = folder, frames, len(whole) - 1  # the last frame is the first one

    def __len__(self) -> int:
        return self._frames

    def frame(self, i: int) -> Frame:
        """Read frame i, which is a frame of the round."""
        with np.load(kept(self._folder, self._checked_index(i) % self._round)) as file:
            return Frame(i, i / FRAMES_PER_SECOND, color_from_bytes(file["color"]), file["depth_m"], self.camera)

    def truth(self) -> Trajectory | None:
        """Return None: only the growth is measured."""
        return None


class Samples(Callback):
    """Samples the process once a second, and ends the run with Ctrl-C after its last frame."""

    def __init__(self, run: RunFolder, last: int) -> None:
        self.run, self.last = run, last
        self.next_s, self.begun_s = 0.0, time.perf_counter()
        self.taken = list[dict[str, float]]()

    def __call__(self, step: Step) -> None:
        """Take a sample if one is due."""
        if step.timestamp_s >= self.next_s:
            self.next_s = step.timestamp_s + SAMPLES_EVERY_S
            self.taken.append(
                {
                    "time_s": round(step.timestamp_s, 3),
                    "resident_mib": round(resident_mib(), 2),
                    "files": float(len(os.listdir("/proc/self/fd"))),
                    "threads": float(threading.active_count()),
                    "splats": float(step.splats),
                }
            )
        if step.index >= self.last:
            signal.raise_signal(signal.SIGINT)


def follow(path: str, scratch: Path, config: Config, frames: int, save_every_s: float) -> dict[str, Any]:
    """Run SLAM in real time on the frames in scratch/frames, repeated; return samples, and figures of each frame."""
    from sigmasplat.commands.options import prepare_torch
    from sigmasplat.plugins.sources.live import Arrivals
    from sigmasplat.realtime.system import RealTime
    from sigmasplat.run.resume import StateFile
    from sigmasplat.run.session import Session
    from sigmasplat.system.slam import Slam

    prepare_torch()
    source = Repeated(open_source(path), scratch / "frames", frames)
    folder = RunFolder.create(scratch / "run", config, source.name)
    slam = Slam(config, folder.submaps)
    read, state = Arrivals(source), StateFile(slam, folder, save_every_s)
    system = RealTime(slam, covariances=False, should_stop=read.hurries)
    state.run_save = system.save
    samples = Samples(folder, frames - 3)  # a late frame may be dropped, but not three in a row at the end
    outcome = Session(system, read, folder, [samples], state, later=system.between_frames).execute()
    log = folder.read_log()
    checked = {"status": outcome.status, "poses": len(folder.read_checkpoint()[0]["frame_submap"])}
    return {
        "frames": len(log),
        "dropped": read.dropped,
        "lost": outcome.lost,
        "submaps": outcome.submaps,
        "loops_tried": len(slam.loops),
        "loops_accepted": outcome.loops_closed,
        "keyframes_refused": system.keyframes_refused,
        "peak_mib": peak_mib(),
        "valid": checked["status"] == "interrupted" and checked["poses"] == len(log) and folder.state.is_file(),
        "each": {
            "index": [line["index"] for line in log],
            "latency_ms": [round(1e3 * line["seconds"]["latency"], 2) for line in log],
            "lost": [int(line["lost"]) for line in log],
        },
        "samples": samples.taken,
    }


def measure(options: Options) -> dict[str, Any]:
    """Render a round, then repeat it in a fresh process in real time; return the figures."""
    options.scratch.mkdir(parents=True, exist_ok=True)
    config, frames = options.config(), round(60 * FRAMES_PER_SECOND * options.minutes)
    with TemporaryDirectory(prefix="long-live-", dir=options.scratch) as folder:
        scratch = Path(folder)
        (scratch / "frames").mkdir()
        draw_all(options.source, scratch / "frames")
        print(f"rendered; {options.minutes:g} minutes follow", file=sys.stderr, flush=True)
        found: dict[str, Any] = alone(follow, options.source, scratch, config, frames, options.save_every)
    each = found.pop("each")
    found["minutes"] = list(by_minute(each, found.pop("samples"), frames))
    return {"source": Path(options.source).name, **found, "slopes": slopes(found["minutes"])}


# ---- figures ----

GROWTH = {"p50_ms": 0.10, "p99_ms": 0.25, "resident_mib": 0.15, "files": 0.0, "threads": 0.0}
"""Largest growth from the second to the last minute, relative to the median of all minutes."""
DROPPED_MOST = 0.001
"""Largest growth of the share of dropped frames."""


def by_minute(each: dict[str, list[float]], samples: list[dict[str, float]], frames: int) -> Iterator[dict[str, float]]:
    """Yield the figures of each minute: latencies, dropped and lost frames, and the largest samples."""
    index, per_minute = np.array(each["index"]), round(60 * FRAMES_PER_SECOND)
    sampled_s = np.array([sample["time_s"] for sample in samples])
    for first in range(0, frames, per_minute):
        here, end = (index >= first) & (index < first + per_minute), min(first + per_minute, frames - 2)
        within = (sampled_s >= first / FRAMES_PER_SECOND) & (sampled_s < (first + per_minute) / FRAMES_PER_SECOND)
        if not here.any() or not within.any():
            return
        latency = np.array(each["latency_ms"])[here]
        p50, p99 = np.quantile(latency, [0.5, 0.99])
        most = {name: max(s[name] for s, yes in zip(samples, within, strict=True) if yes) for name in samples[0]}
        del most["time_s"]
        yield {
            "frames": int(here.sum()), "dropped": max(end - first - int(here.sum()), 0),
            "lost": int(np.array(each["lost"])[here].sum()), "p50_ms": round(float(p50), 2),
            "p99_ms": round(float(p99), 2), "worst_ms": float(latency.max()), **most,
        }  # fmt: skip


def slopes(minutes: list[dict[str, float]]) -> dict[str, float]:
    """Return the growth of each figure over the run: the median slope of all pairs of minutes (Theil and Sen), times
    the length of the run, relative to the median; for the share of dropped frames not relative. Empty if fewer than
    three minutes count."""
    counted = minutes[SETTLING_MINUTES:]
    if len(counted) < 3:
        return {}
    values = {name: np.array([minute[name] for minute in counted], np.float64) for name in GROWTH}
    found = {name: _growth(series) / float(np.median(series)) for name, series in values.items()}
    shares = np.array([minute["dropped"] / (minute["dropped"] + minute["frames"]) for minute in counted])
    return found | {"dropped": _growth(shares)}


def _growth(series: np.ndarray[Any, Any]) -> float:
    return float(theilslopes(series).slope) * (len(series) - 1)


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by long_live.py."""
    figures = measured["figures"]
    return [minutes_table(figures), goals(figures)]


def minutes_table(figures: dict[str, Any]) -> Section:
    """Tabulate the figures of each minute."""
    head = ["minute", "frames", "dropped", "lost", "image to pose, ms: median", "99 %", "worst", "MiB", "open files"]
    head += ["threads", "splats"]
    rows = [
        [
            str(number), *(str(part[name]) for name in ("frames", "dropped", "lost")),
            *(significant(part[name]) for name in ("p50_ms", "p99_ms", "worst_ms", "resident_mib")),
            *(str(round(part[name])) for name in ("files", "threads", "splats")),
        ]
        for number, part in enumerate(figures["minutes"], 1)
    ]  # fmt: skip
    note = (
        f"{figures['source']}, repeated at 30 Hz: {figures['frames']} frames tracked, {figures['dropped']} dropped, "
        f"{figures['lost']} lost, {figures['submaps']} submaps, loops accepted {figures['loops_accepted']} of "
        f"{figures['loops_tried']} tried. The run folder after Ctrl-C is {'' if figures['valid'] else '**not** '}valid."
        + (f" Most memory, while the map is written: {figures['peak_mib']} MiB." if "peak_mib" in figures else "")
    )
    return Section("Minutes", head, rows, note)


def goals(figures: dict[str, Any]) -> Section:
    """Compare the growth of each figure with its goal."""
    rows, most = [], GROWTH | {"dropped": DROPPED_MOST}
    for name, what in NAMES.items():
        growth = figures["slopes"].get(name)
        reached = "–" if growth is None else "yes" if growth <= most[name] else "**no**"
        rows.append([what, "–" if growth is None else f"{growth:+.1%}", f"≤ {most[name]:.1%}", reached])
    note = (
        "Growth: the median slope between two minutes (Theil and Sen) times the length of the run, relative to the "
        "median minute. The first minute is left out."
    )
    return Section("Growth", ["figure", "growth over the run", "goal", "reached"], rows, note)


NAMES = {
    "p50_ms": "image to pose, median", "p99_ms": "image to pose, 99 %", "resident_mib": "resident memory",
    "files": "open files", "threads": "threads", "dropped": "share of dropped frames, not relative",
}  # fmt: skip


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        settings = (*options.settings, QUICK_SETTING)
        options = replace(options, source=QUICK_SOURCE, settings=settings, minutes=min(options.minutes, 3.0))
    name = Path(options.source).name
    return program.run("long_live", options, measure, [options.seed], not options.quick, source=name)


if __name__ == "__main__":
    program.start(main, Options)
