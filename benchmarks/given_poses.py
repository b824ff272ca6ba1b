"""Measure maps from known poses beside maps whose poses are tracked.

The true poses of each sequence are written as TUM text in half metres; `run --poses FILE --set input.poses_scale=0`
measures their unit and uses them. One run with them and one that tracks, each in a process of its own.
Writes benchmarks/results/given_poses-<machine>.json and prints a table.

example: python benchmarks/given_poses.py --sources livingroom --seeds 0
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import realtime
import record
import tyro
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.trajectory import write_trajectory

arg = tyro.conf.arg
METRES_PER_UNIT = 0.5


@dataclass(frozen=True)
class Options:
    """Run with known poses, and with tracked ones."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "synthetic:frames=200,noise=1",
        "livingroom",
        "redkitchen",
        "hololens",
    )
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, two runs for each")] = (0,)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("input.hold_every=5",)
    limit: Annotated[int | None, arg(help="number of frames at most")] = 200
    name: Annotated[str, arg(help="name of the results")] = "given_poses"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def write_poses(source: str, path: Path) -> None:
    """Write the true poses in another unit."""
    truth = open_source(source).truth()
    assert truth is not None
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] /= METRES_PER_UNIT
    write_trajectory(path, Trajectory(truth.timestamps_s, poses))


def measure_pair(name: str, seed: int, options: Options) -> list[dict[str, Any]]:
    """Make both runs of a sequence."""
    source, found = accuracy.located(name), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as scratch:
        poses = Path(scratch) / "poses.txt"
        write_poses(source, poses)
        chosen = replace(options, settings=(*options.settings, "input.poses_scale=0"))
        for given in (True, False):
            out, more = Path(scratch) / str(given), ("--poses", str(poses)) if given else ()
            run = realtime.made(source, seed, chosen if given else options, out, *more)
            unit = run.config().input.poses_scale / METRES_PER_UNIT if given else None
            metrics = run.read_metrics()
            held_out = metrics["held_out"]
            found.append(
                {
                    "source": Path(source).name, "seed": seed, "given": given, "unit": unit,
                    "frames": metrics["frames"], "lost": metrics["lost"], "ate_cm": 100 * metrics["ate"]["rmse_m"],
                    "psnr_db": held_out["psnr_db"], "depth_l1_cm": 100 * held_out["depth_l1_m"],
                    "frames_per_s": metrics["frames_per_s"],
                }
            )  # fmt: skip
    return found


def measure(options: Options) -> dict[str, Any]:
    """Make every run."""
    pairs = [measure_pair(name, seed, options) for name in options.sources for seed in options.seeds]
    return {"runs": [run for pair in pairs for run in pair]}


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the runs."""
    runs = measured["figures"]["runs"]
    rows = [
        [r["source"], str(r["seed"]), "given" if r["given"] else "tracked",
         significant(r["unit"], 4), significant(r["ate_cm"]), significant(r["psnr_db"], 4),
         significant(r["depth_l1_cm"]), significant(r["frames_per_s"])]
        for r in runs
    ]  # fmt: skip
    off = 100 * max((abs(r["unit"] - 1) for r in runs if r["given"]), default=np.nan)
    columns = ("sequence", "seed", "poses", "unit", "ATE, cm", "PSNR, dB", "depth L1, cm", "frames/s")
    note = f"Given: the true poses in half metres. Unit: measured, relative to the true one, at most {off:.1f} % off."
    return [Section("Known poses beside tracked ones", columns, rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("given_poses", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
