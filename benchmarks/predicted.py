"""Measure RGB only: a folder of colour images with the depth that a network may predict, with and without fitting it.

The built-in room writes colour images, and depth with a smooth scale error of 10 %, 10 % noise at each pixel, and an
arbitrary unit (`synthetic:predicted=1`). `run FOLDER --predicted-depth …` is scored after alignment with a scale
factor.
Writes benchmarks/results/predicted-<machine>.json and prints a table.

example: python benchmarks/predicted.py --seeds 0
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import realtime
import record
import tyro
from PIL import Image
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset
from sigmasplat.data.se3 import quaternion_from_rotation
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
UNIT = 37.0
"""Predicted depth is stored in this unit, which the run does not know."""
GOAL_CM = 5.0


@dataclass(frozen=True)
class Options:
    """Run on colour images with predicted depth."""

    seeds: Annotated[tuple[int, ...], arg(help="seeds of the room and of the run")] = (0, 1, 2)
    frames: Annotated[int, arg(help="number of frames")] = 200
    fit: Annotated[tuple[int, ...], arg(help="whether depth is fitted to the map: 1, 0")] = (1, 0)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("final.iterations=0",)
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    name: Annotated[str, arg(help="name of the results")] = "predicted"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def write_folder(source: Source, folder: Path) -> None:
    """Write colour images, predicted depth, calibration.json and groundtruth.txt."""
    for name in ("rgb", "predicted"):
        (folder / name).mkdir(parents=True)
    for frame in source:
        name = f"{frame.timestamp_s:.6f}"
        Image.fromarray(np.rint(255.0 * frame.color).astype(np.uint8)).save(folder / "rgb" / f"{name}.png")
        np.save(folder / "predicted" / f"{name}.npy", (UNIT * frame.depth_m).astype(np.float32))
    c, truth = source.camera, source.truth()
    assert truth is not None
    (folder / "calibration.json").write_text(f'{{"fx": {c.fx}, "fy": {c.fy}, "cx": {c.cx}, "cy": {c.cy}}}')
    lines = []
    for t, T in zip(truth.timestamps_s, truth.T_world_camera, strict=True):
        w, x, y, z = quaternion_from_rotation(T[:3, :3])
        lines.append(" ".join(f"{value:.9f}" for value in (t, *T[:3, 3], x, y, z, w)))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")


def measure_run(folder: Path, seed: int, fit: int, options: Options, out: Path) -> dict[str, Any]:
    """Make one run; return its path error in cm, its scale factor and its lost frames."""
    more = () if fit else ("tracking.fit_depth=false",)
    chosen = replace(options, settings=(*options.settings, *more))
    run = realtime.made(str(folder), seed, chosen, out, "--predicted-depth", str(folder / "predicted"))
    found = realtime.figures_of(run)
    kept = {name: found[name] for name in ("frames", "lost", "ate_cm")}
    return {"seed": seed, "fit": bool(fit), "scale": RunFolder(out).read_metrics()["path_scale"]} | kept


def measure(options: Options) -> dict[str, Any]:
    """Make every run."""
    runs = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "images"
            write_folder(open_source(f"synthetic:frames={options.frames},seed={seed},predicted=1"), folder)
            runs += [measure_run(folder, seed, fit, options, Path(scratch) / f"run-{fit}") for fit in options.fit]
    return {"runs": runs}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the path of each run."""
    rows = [
        [str(r["seed"]), "fitted" if r["fit"] else "as predicted", f"{r['lost']} of {r['frames']}",
         significant(r["scale"]), "–" if r["ate_cm"] is None else significant(r["ate_cm"])]
        for r in measured["figures"]["runs"]
    ]  # fmt: skip
    fitted = [r["ate_cm"] for r in measured["figures"]["runs"] if r["fit"] and r["ate_cm"] is not None]
    mean = f"{np.mean(fitted):.2f} ± {np.std(fitted):.2f} cm" if fitted else "none"
    note = f"ATE after alignment with a scale factor, which is the scale shown. Fitted: {mean}; goal: ≤ {GOAL_CM:g} cm."
    return [Section("Paths from predicted depth", ("seed", "depth", "lost frames", "scale", "ATE, cm"), rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("predicted", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
