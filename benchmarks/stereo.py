"""Measure stereo input: the path from a stereo pair beside that from RGB-D, and whether σ_z covers the errors of depth.

Runs: each recording and seed is a run in a process of its own. Depth: pairs of the synthetic room, compared with exact
depth. Rooms and baselines are not those that the constants of matching were fitted on.
Writes benchmarks/results/stereo-<machine>.json and prints tables.

example: python benchmarks/stereo.py --sources street --seeds 0
"""

import tempfile
from dataclasses import dataclass
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
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.synthetic import SyntheticRoom
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
ROOM = "synthetic:frames=200,noise=1"


@dataclass(frozen=True)
class Options:
    """Compare stereo input with RGB-D; compare the errors of stereo depth with their standard deviation."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "street", f"{ROOM},stereo=10", ROOM,
    )  # fmt: skip
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    rooms: Annotated[tuple[int, ...], arg(help="seeds of the synthetic rooms whose depth is compared")] = (11, 12, 13)
    baselines_cm: Annotated[tuple[int, ...], arg(help="baselines of the pairs whose depth is compared")] = (8, 15)
    frames: Annotated[tuple[int, ...], arg(help="frames whose depth is compared")] = (5, 25, 45, 65, 85)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("final.iterations=0",)
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    name: Annotated[str, arg(help="name of the results")] = "stereo"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure_path(source: str, seed: int, options: Options) -> dict[str, Any]:
    """Make one run; return its path error in cm, the length of its path in m, and its lost frames."""
    with tempfile.TemporaryDirectory() as scratch:
        run = realtime.made(accuracy.located(source), seed, options, Path(scratch) / "run")
        found, length_m = realtime.figures_of(run), path_length_m(run)
    kept = {name: found[name] for name in ("frames", "lost", "ate_cm")}
    return {"source": source, "seed": seed, "length_m": length_m} | kept


def path_length_m(run: RunFolder) -> float:
    """Return the length of the estimated path."""
    positions = np.array([line["T_world_camera"] for line in run.read_log()])[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def measure_depth(room: int, baseline_cm: int, frames: tuple[int, ...]) -> dict[str, Any]:
    """Return the shares of errors of stereo depth within 1 and 1.96 σ_z, and the share of pixels with depth."""
    source = open_source(f"synthetic:frames={max(frames) + 1},noise=1,seed={room},stereo={baseline_cm}")
    assert isinstance(source, SyntheticRoom) and source._matcher
    ratios, covered = [], []
    for i in frames:
        left = np.rint(source.frame(i).color * 255.0).astype(np.uint8)
        depth_m, std_m = source._matcher.depth_and_std_m(left, source.right_image(i))
        read = depth_m > 0
        ratios.append(np.abs(depth_m - source.exact_depth_of(i))[read] / std_m[read])
        covered.append(read.mean())
    found = np.concatenate(ratios)
    return {
        "room": room, "baseline_cm": baseline_cm, "within_1": float((found < 1).mean()),
        "within_1_96": float((found < 1.96).mean()), "covered": float(np.mean(covered)),
    }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Measure every path and every pair."""
    return {
        "runs": [measure_path(source, seed, options) for source in options.sources for seed in options.seeds],
        "depth": [measure_depth(room, b, options.frames) for room in options.rooms for b in options.baselines_cm],
    }


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the path of each run, and the depth of each pair."""
    runs = [
        [Path(r["source"]).name, str(r["seed"]), significant(r["length_m"]), f"{r['lost']} of {r['frames']}",
         "–" if r["ate_cm"] is None else significant(r["ate_cm"])]
        for r in measured["figures"]["runs"]
    ]  # fmt: skip
    depth = [
        [f"room {d['room']}, {d['baseline_cm']} cm", *(f"{100 * d[name]:.1f}" for name in SHARES)]
        for d in measured["figures"]["depth"]
    ]
    note = "For normal errors 68.3 % are within σ_z, and 95 % within 1.96 σ_z. Depth is exact, images have noise."
    return [
        Section("Paths from stereo pairs", ("sequence", "seed", "path, m", "lost frames", "ATE, cm"), runs),
        Section("Errors of stereo depth", ("pair", *DEPTH_COLUMNS), depth, note),
    ]


SHARES = ("within_1", "within_1_96", "covered")
DEPTH_COLUMNS = ("within σ_z, %", "within 1.96 σ_z, %", "pixels with depth, %")


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("stereo", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
