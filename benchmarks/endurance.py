"""Run SLAM at the clock of its frames for a long time; test whether time per frame, memory or files grow (issue 21).

All cores render one round through a small synthetic room first. Then a fresh process runs on it again and again, as
`sigmasplat run` does: log, saved states and submaps on disk. Ctrl-C ends it after the time asked for.
Figures are taken ten times. Each figure's slope is given per hour, and per thousand frames, by the median of all pairs.
Log and submaps grow with the frames by design; time per frame, open files and threads must not.
Writes benchmarks/results/endurance-<machine>.json and prints tables. Linux only.

example: python benchmarks/endurance.py --minutes 60
"""

import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from cpu import alone
from long_live import Repeated
from long_run import draw_all, resident_mib
from scipy.stats import theilslopes
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.callbacks import Callback
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.slam.results import Step

arg = tyro.conf.arg
SOURCE = "synthetic:frames=300,noise=1,width=64,height=48"
"""A closed path, so that the last frame is beside the first one."""
MOST_FRAMES, PARTS = 10_000_000, 10
COLUMNS = ("cpu_ms", "resident_mib", "files", "threads", "log_kb", "state_kb", "submaps_kb", "splats")


@dataclass(frozen=True)
class Options:
    """Run SLAM for a long time, and test whether time per frame, memory or files grow."""

    minutes: Annotated[float, arg(help="length of the run")] = 60.0
    source: Annotated[str, arg(help="sequence that ends where it begins; it is repeated")] = SOURCE
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("input.width=64",)
    seed: int = 0
    save_every: Annotated[float, arg(help="seconds between saves of the state, 0 = none")] = 60.0
    quick: Annotated[bool, arg(help="print the tables, write no results", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "endurance"
    scratch: Annotated[Path, arg(help="folder for frames and run, removed afterwards")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self) -> Config:
        """Return the run's settings. Raises ConfigError for an unknown preset or setting."""
        return override(preset_of(self.preset), split_settings(self.settings) | {"seed": str(self.seed)})


class Watch(Callback):
    """Takes figures in equal intervals, and ends the run with Ctrl-C."""

    def __init__(self, run: RunFolder, seconds: float) -> None:
        self.run, self.every_s, self.parts = run, seconds / PARTS, list[dict[str, float]]()
        self.begun_s = self.since_s = time.monotonic()
        self.cpu_s, self.frames = time.process_time(), 0

    def __call__(self, step: Step) -> None:
        """Take the figures of an interval if it has ended."""
        self.frames += 1
        if (now_s := time.monotonic()) < self.since_s + self.every_s:
            return
        cpu_s = time.process_time()
        self.parts.append(
            {
                "hours": (now_s - self.begun_s) / 3600, "frame": float(step.index), "frames": float(self.frames),
                "cpu_ms": 1e3 * (cpu_s - self.cpu_s) / self.frames, "resident_mib": resident_mib(),
                "files": float(len(os.listdir("/proc/self/fd"))), "threads": float(threading.active_count()),
                "log_kb": _kilobytes(self.run.path / "log.jsonl"), "state_kb": _kilobytes(self.run.state),
                "submaps_kb": _kilobytes(self.run.path / "submaps"), "splats": float(step.splats),
            }
        )  # fmt: skip
        self.since_s, self.cpu_s, self.frames = now_s, cpu_s, 0
        if len(self.parts) == PARTS:
            signal.raise_signal(signal.SIGINT)


def _kilobytes(path: Path) -> float:
    """Return the size of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e3


def follow(path: str, scratch: Path, config: Config, seconds: float, save_every_s: float) -> dict[str, Any]:
    """Run SLAM on the frames in scratch/frames, repeated, for a time; return its figures."""
    from sigmasplat.commands.options import prepare_torch
    from sigmasplat.run.resume import StateFile
    from sigmasplat.run.session import Session
    from sigmasplat.system.slam import Slam

    prepare_torch()
    source = Repeated(open_source(path), scratch / "frames", MOST_FRAMES)
    run = RunFolder.create(scratch / "run", config, source.name)
    slam = Slam(config, run.submaps)
    watch = Watch(run, seconds)
    outcome = Session(slam, source, run, [watch], StateFile(slam, run, save_every_s)).execute()
    return {
        "status": outcome.status, "frames": len(run.read_log()), "lost": outcome.lost, "submaps": outcome.submaps,
        "loops_accepted": outcome.loops_closed, "parts": watch.parts,
    }  # fmt: skip


def slopes(parts: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the slope of each figure per hour and per thousand frames, and relative to its median per hour.

    The first interval is left out: libraries are loaded, and memory grows to its usual size.
    """
    found, rest = dict[str, dict[str, float]](), parts[1:]
    for name in COLUMNS:
        values = np.array([part[name] for part in rest])
        per_hour = float(theilslopes(values, [part["hours"] for part in rest])[0])
        per_frame = float(theilslopes(values, [part["frame"] / 1e3 for part in rest])[0])
        middle = float(np.median(values))
        found[name] = {
            "per_hour": per_hour, "per_1000_frames": per_frame, "median": middle,
            "relative_per_hour": per_hour / middle if middle else 0.0,
        }  # fmt: skip
    return found


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of the results."""
    figures = measured["figures"]
    parts = [[significant(part[name]) for name in ("frame", *COLUMNS)] for part in figures["parts"]]
    growth = [
        [name, significant(each["median"]), significant(each["per_hour"]), significant(each["per_1000_frames"])]
        for name, each in figures["slopes"].items()
    ]
    title = f"{figures['frames']} frames, {figures['lost']} lost, {figures['submaps']} submaps"
    return [
        Section(title, ("frame", *COLUMNS), parts),
        Section("Growth", ("figure", "median", "per hour", "per 1000 frames"), growth),
    ]


def main(options: Options) -> int:
    """Render a round, repeat it in a fresh process, write the figures, and print the tables."""
    options.scratch.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="endurance-", dir=options.scratch) as folder:
        scratch = Path(folder)
        (scratch / "frames").mkdir()
        draw_all(options.source, scratch / "frames")
        print(f"rendered; {options.minutes:g} minutes follow", file=sys.stderr, flush=True)
        seconds = 60 * options.minutes
        found: dict[str, Any] = alone(follow, options.source, scratch, options.config(), seconds, options.save_every)
    figures = {"source": options.source, "minutes": options.minutes, **found, "slopes": slopes(found["parts"])}
    measured = program.keep("endurance", figures, options, [options.seed], not options.quick)
    print("\n".join(section.markdown() for section in sections(measured)))
    return 0


if __name__ == "__main__":
    program.start(main, Options, __doc__)
