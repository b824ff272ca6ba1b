"""Run a preset on CUDA on recordings that are read beforehand: frames per second, path, memory, beside the CPU.

Writes benchmarks/results/<name>-<machine>.json after each recording and prints its table.

example: python benchmarks/gpu_slam.py --recordings ../shared/data/livingroom --beside
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import tables
import torch
import tyro
from gpu import card, row
from gpu_works import describe_device, refuse_without_device
from tables import Section, significant

from sigmasplat.config import Config
from sigmasplat.config.find_preset import configured
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg


@dataclass(frozen=True)
class Options:
    """Run a preset on CUDA on recordings that are read beforehand."""

    preset: str = "sigma"
    recordings: Annotated[tuple[str, ...], arg(help="paths as for `sigmasplat run`")] = ("synthetic:frames=60",)
    frames: Annotated[int, arg(help="most frames of a recording")] = 60
    width: Annotated[int, arg(help="working width, pixels")] = 640
    seconds: Annotated[float, arg(help="a run ends after this time; its frames so far count")] = 20.0
    beside: Annotated[bool, arg(help="run on the CPU too, and compare the paths")] = False
    settings: Annotated[tuple[str, ...], arg(help="settings to replace, NAME=VALUE")] = ()
    seed: int = 0
    name: Annotated[str, arg(help="name of the results")] = "gpu-slam"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def followed(config: Config, frames: Sequence[Frame], seconds: float) -> tuple[Slam, list[float]]:
    """Give the frames to SLAM until they or the time is over; return it, and the seconds of each frame."""
    slam, taken = Slam(config), list[float]()
    for frame in frames:
        start = time.perf_counter()
        slam.step(frame)
        if config.backend == "cuda":
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - start)
        if sum(taken) > seconds:
            break
    return slam, taken


def measure(path: str, options: Options) -> dict[str, Any]:
    """Run one recording; the first frame, for which programs are loaded and a map is begun, is timed apart."""
    source, o = open_source(path), options
    frames = [source.frame(i) for i in range(min(o.frames, len(source)))]
    values = {"backend": "cuda", "seed": o.seed, "input.width": o.width}
    config = configured(o.preset, values | dict(text.split("=", 1) for text in o.settings))
    torch.cuda.reset_peak_memory_stats()
    slam, taken = followed(config, frames, o.seconds)
    found: dict[str, Any] = {
        "recording": Path(path).name.partition(":")[0], "frames": len(taken), "first_s": taken[0],
        "frames_per_s": (len(taken) - 1) / sum(taken[1:]) if len(taken) > 1 else None,
        "median_ms": 1e3 * float(np.median(taken)), "longest_ms": 1e3 * max(taken[1:], default=taken[0]),
        "lost": int(slam.steps.lost.sum()), "splats": len(slam.field),
        "peak_mib": round(torch.cuda.max_memory_allocated() / 2**20, 1), "ate_m": None, "apart_m": None,
    }  # fmt: skip
    if (truth := source.truth()) is not None and len(taken) > 2:
        found["ate_m"] = float(ate(slam.trajectory(), truth).rmse_m)
    if o.beside:
        other, _ = followed(replace(config, backend="cpu"), frames, o.seconds)
        ours, theirs = (run.trajectory().T_world_camera[:, :3, 3] for run in (slam, other))
        both = min(len(ours), len(theirs))
        found |= {"compared": both, "apart_m": float(np.linalg.norm(ours[:both] - theirs[:both], axis=1).max())}
    return found


# ---- tables ----

LEAST_FRAMES_PER_S = {"sigma": 100.0, "cgslam-tum": 100.0, "varsplat-tum": 15.0}
MOST_APART_M = 1e-3


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results: the runs, and the goals of issue 59."""
    figures, preset = measured["figures"], measured["config"]["preset"]
    head = ["recording", "frames", "frames/s", "median, ms", "longest, ms", "first, s", "ATE, cm", "lost", "splats, k"]
    head += ["peak, MiB", "from the CPU's path, mm"]
    runs = [_cells(run) for run in figures["runs"]]
    made = [Section(f"{preset} on CUDA", head, runs, card(figures["device"]))]
    goals = [goal for run in figures["runs"] for goal in _goals(preset, run)]
    return [*made, Section("Goals", ["figure", "goal", "measured", "reached"], goals)] if goals else made


def _cells(run: dict[str, Any]) -> list[str]:
    scaled = [run["frames_per_s"], run["median_ms"], run["longest_ms"], run["first_s"], _times(run["ate_m"], 100.0)]
    rest = [str(run["lost"]), significant(run["splats"] / 1e3), f"{run['peak_mib']:.0f}"]
    figures = [significant(value) for value in scaled]
    return [run["recording"], str(run["frames"]), *figures, *rest, significant(_times(run["apart_m"], 1e3))]


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _goals(preset: str, run: dict[str, Any]) -> Iterator[list[str]]:
    if preset in LEAST_FRAMES_PER_S and run["frames_per_s"] is not None:
        yield row(f"frames/s, {run['recording']}", "≥", LEAST_FRAMES_PER_S[preset], run["frames_per_s"])
    if run["apart_m"] is not None:
        yield row(f"from the CPU's path, m, {run['recording']}", "≤", MOST_APART_M, run["apart_m"])


def main(options: Options) -> int:
    """Run, write after each recording, print; return the exit code."""
    try:
        refuse_without_device()
        figures: dict[str, Any] = {"device": describe_device(), "runs": []}
        for path in options.recordings:
            figures["runs"].append(measure(path, options))
            measured = program.keep("gpu_slam", figures, options, [options.seed])
    except (SigmaSplatError, ValueError) as problem:
        return program.refuse("gpu_slam", problem)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
