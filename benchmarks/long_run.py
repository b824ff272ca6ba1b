"""Run so many frames that submaps accumulate, and measure whether frames get slower or memory grows (issue 4).

All cores render the frames first. Then a fresh process runs SLAM on them alone, with finished submaps on disk and
images read ahead by a thread, as `sigmasplat run` does. The time of each frame and the resident memory after it are
recorded. Writes benchmarks/results/long-run-<machine>.json and prints tables. Linux only.

example: python benchmarks/long_run.py --quick
"""

import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from cpu import alone
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import color_from_bytes
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.machine import usable_cores
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.submaps import DiskStore

arg = tyro.conf.arg
SOURCE = "synthetic:frames=2400,rooms=2,loops=4,noise=1"
"""Four turns, so that each quarter of the run sees the whole scene once."""
QUICK_SOURCE, QUICK_SETTING = "synthetic:frames=240,loops=4,noise=1,width=160,height=120", "input.width=160"
STATM = Path("/proc/self/statm")


@dataclass(frozen=True)
class Options:
    """Run so many frames that submaps accumulate, and measure whether frames get slower or memory grows."""

    source: Annotated[str, arg(help="sequence, at least 2000 frames for a result")] = SOURCE
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    seed: int = 0
    finish: Annotated[bool, arg(help="also make the final map after the frames")] = True
    quick: Annotated[bool, arg(help="about a minute: 240 small frames, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "long-run"
    scratch: Annotated[Path, arg(help="folder for the frames and submaps, removed afterwards: 2 GB")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self) -> Config:
        """Return the run's settings. Raises ConfigError for an unknown preset or setting."""
        return override(preset_of(self.preset), split_settings(self.settings) | {"seed": str(self.seed)})


class Drawn(Source):
    """Frames of another source, saved in a folder by `draw`."""

    def __init__(self, whole: Source, folder: Path) -> None:
        super().__init__(whole.name, whole.camera)
        self._whole, self._folder = whole, folder

    def __len__(self) -> int:
        return len(self._whole)

    def frame(self, i: int) -> Frame:
        """Read frame i."""
        with np.load(kept(self._folder, self._checked_index(i))) as file:
            color = color_from_bytes(file["color"])
            return Frame(i, float(file["timestamp_s"]), color, file["depth_m"], self.camera)

    def truth(self) -> Trajectory | None:
        """Return the true path of the original source."""
        return self._whole.truth()


def kept(folder: Path, i: int) -> Path:
    """Return the file of frame i."""
    return folder / f"{i:06d}.npz"


def draw(path: str, folder: Path, indices: range) -> None:
    """Save frames of a source, with colour as 8-bit values like those of a camera."""
    source = open_source(path)
    for i in indices:
        frame = source.frame(i)
        color = np.rint(255.0 * frame.color).astype(np.uint8)
        np.savez(kept(folder, i), color=color, depth_m=frame.depth_m, timestamp_s=frame.timestamp_s)


def draw_all(path: str, folder: Path) -> None:
    """Save all frames of a source, rendered by all cores."""
    workers, frames = usable_cores(), len(open_source(path))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        parts = [pool.submit(draw, path, folder, range(k, frames, workers)) for k in range(workers)]
        for part in parts:
            part.result()


def resident_mib() -> float:
    """Return the resident memory of this process, MiB. Raises SourceError without /proc."""
    try:
        pages = int(STATM.read_text().split()[1])
    except OSError as problem:
        raise SourceError(
            f"resident memory is read from {STATM}, which this system does not have ({problem})"
        ) from problem
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def follow(path: str, scratch: Path, config: Config, finish: bool) -> dict[str, Any]:
    """Run SLAM on the frames in scratch/frames; return time, memory and submap of each, and figures of the run.

    seconds: `Step.seconds["total"]`, without reading the frame; resident_mib: after the frame.
    """
    from sigmasplat.system.slam import Slam

    source, seconds, resident, submaps, lost = Drawn(open_source(path), scratch / "frames"), [], [], [], 0
    slam = Slam(config, DiskStore(scratch / "submaps"))
    for frame in source:
        step = slam.step(frame)
        seconds.append(round(step.seconds["total"], 6))
        resident.append(round(resident_mib(), 2))
        submaps.append(step.submap)
        lost += step.lost
    clock = time.perf_counter()
    if finish:
        slam.finish()
    after = {"finish_s": round(time.perf_counter() - clock, 2), "resident_mib": round(resident_mib(), 2)}
    truth = source.truth()
    return {
        "frames": len(seconds),
        "lost": lost,
        "submaps": submaps[-1] + 1,
        "loops_tried": len(slam.loops),
        "loops_accepted": sum(loop.accepted for loop in slam.loops),
        "ate_m": None if truth is None else ate(slam.trajectory(), truth).rmse_m,
        "finish": after if finish else None,
        "each": {"seconds": seconds, "resident_mib": resident, "submap": submaps},
    }


def measure(options: Options) -> dict[str, Any]:
    """Render the frames, then run SLAM on them in a fresh process; return the figures."""
    options.scratch.mkdir(parents=True, exist_ok=True)
    config = options.config()
    with TemporaryDirectory(prefix="long-run-", dir=options.scratch) as folder:
        scratch = Path(folder)
        (scratch / "frames").mkdir()
        clock = time.perf_counter()
        draw_all(options.source, scratch / "frames")
        print(f"frames rendered in {time.perf_counter() - clock:.0f} s", file=sys.stderr, flush=True)
        found: dict[str, Any] = alone(follow, options.source, scratch, config, options.finish)
    return {"source": Path(options.source).name, **found}


# ---- tables ----


FRAMES, SLOWER, LARGER = 2000, 0.10, 0.15
"""Issue 4: in at least 2000 frames the last quarter's time within 10 %, its memory within 15 % of the second's."""


def quarters(each: dict[str, list[float]]) -> list[dict[str, float]]:
    """Summarise each quarter of the frames: seconds per frame, resident memory, submaps at its end."""
    parts = {name: np.array_split(np.array(values), 4) for name, values in each.items()}
    return [
        {
            "frames": len(seconds),
            "median_s": float(np.median(seconds)),
            "mean_s": float(seconds.mean()),
            "longest_s": float(seconds.max()),
            "median_mib": float(np.median(resident)),
            "most_mib": float(resident.max()),
            "submaps": int(submap[-1]) + 1,
        }
        for seconds, resident, submap in zip(parts["seconds"], parts["resident_mib"], parts["submap"], strict=True)
    ]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by long_run.py."""
    figures = measured["figures"]
    return [by_quarter(figures), goals(figures)]


def by_quarter(figures: dict[str, Any]) -> Section:
    """Tabulate time and memory by quarter."""
    rows = []
    for number, part in enumerate(quarters(figures["each"]), 1):
        times = [1e3 * part[name] for name in ("median_s", "mean_s", "longest_s")]
        cells = [*times, part["median_mib"], part["most_mib"]]
        rows.append([str(number), str(part["frames"]), str(part["submaps"]), *map(significant, cells)])
    head = ["quarter", "frames", "submaps at its end", "ms per frame, median", "… mean", "… longest", "MiB, median"]
    ate_m, finish = figures["ate_m"], figures["finish"]
    note = (
        f"{figures['source']}: lost {figures['lost']}, loops accepted {figures['loops_accepted']} of "
        f"{figures['loops_tried']} tried, ATE {significant(None if ate_m is None else 100 * ate_m)} cm."
    )
    if finish:
        note += f" The final map took {significant(finish['finish_s'])} s, {significant(finish['resident_mib'])} MiB."
    return Section("Quarters", [*head, "… max"], rows, note)


def goals(figures: dict[str, Any]) -> Section:
    """Compare the last quarter with the second. The median frame is not mapped; the mean includes mapping."""
    _, second, _, last = quarters(figures["each"])
    rows = [["frames", str(figures["frames"]), f"≥ {FRAMES}", _held(figures["frames"] >= FRAMES)]]
    for what, name, most in (
        ("time per frame, median", "median_s", SLOWER),
        ("… mean", "mean_s", SLOWER),
        ("resident memory, median", "median_mib", LARGER),
    ):
        ratio = last[name] / second[name]
        rows.append([what, significant(ratio), f"{1 - most:.2f} … {1 + most:.2f}", _held(abs(ratio - 1) <= most)])
    return Section("Goals", ["last quarter / second quarter", "measured", "goal", "reached"], rows)


def _held(yes: bool) -> str:
    return "yes" if yes else "**no**"


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = replace(options, source=QUICK_SOURCE, settings=(*options.settings, QUICK_SETTING))
    name = Path(options.source).name
    return program.run("long_run", options, measure, [options.seed], not options.quick, source=name)


if __name__ == "__main__":
    program.start(main, Options)
