"""Measure whether the covariances of a run's poses cover their true errors (issue 17).

Runs SLAM on sequences with known truth. Scores three kinds of motions as `sigmasplat eval` does: from each keyframe
to the next, over 50 frames, and from the first frame.
Writes benchmarks/results/pose_covariance-<machine>.json and prints a table.

example: python benchmarks/pose_covariance.py --sources synthetic:frames=200,noise=1 --width 240
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from cpu import alone
from tables import Section, significant

from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override
from sigmasplat.errors import SourceError
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.plugins.evaluation.path_scores import MOTIONS, score_path_covariance
from sigmasplat.run.scene import open_scene
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
NOISY = f"{accuracy.SYNTHETIC},noise=1"
POOLED = "mean of the rooms with noise"
Column = tuple[str, str, float]
"""Heading, figure, and factor to the unit of the heading."""
COLUMNS: tuple[Column, ...] = (
    ("NEES, mean", "nees_mean", 1.0),
    ("… median", "nees_median", 1.0),
    ("in the 90 % ellipsoid, %", "coverage_90", 100.0),
    ("position: in its 90 % ellipsoid, %", "position_coverage_90", 100.0),
    ("… k", "position_k", 1.0),
)
WITH_TRUTH: tuple[Column, ...] = (
    ("with the truth's own error, %", "coverage_90_with_truth", 100.0),
    ("… position, %", "position_coverage_90_with_truth", 100.0),
    ("… position, k", "position_k_with_truth", 1.0),
)
"""Only where a truth was measured."""


@dataclass(frozen=True)
class Options:
    """Compare the covariances of poses with their true errors."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, paths, or rooms")] = (
        accuracy.SYNTHETIC,
        NOISY,
        f"{NOISY},seed=1",
        f"{NOISY},seed=2",
        "livingroom",
        "redkitchen",
    )
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    width: Annotated[int, arg(help="width of the working images, pixels; 0 = as recorded")] = 0
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    truth_error: Annotated[
        tuple[float, float] | None, arg(help="own error of a true pose, m and °, where the recording does not say")
    ] = None
    name: Annotated[str, arg(help="name of the results")] = "pose-covariance"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(path: str, options: Options) -> dict[str, Any]:
    """Run one sequence and score its poses. Raises SourceError if it cannot be read or has no truth."""
    settings = {"final.iterations": 0, "input.width": options.width, "input.limit": options.limit or 0}
    config = override(preset_of(options.preset), {name: str(value) for name, value in settings.items()})
    source, config = open_scene(path, config)
    slam, truth = Slam(config), source.truth()
    if truth is None:
        raise SourceError(f"{path} has no ground truth")
    if options.truth_error and truth.error_rms is None:
        truth = replace(truth, error_rms=(options.truth_error[0], float(np.deg2rad(options.truth_error[1]))))
    for frame in source:
        slam.step(frame)
    slam.finish()
    errors = PathCovariance.of(slam.checkpoint())
    assert errors is not None
    valid = np.flatnonzero(slam.valid())
    found = score_path_covariance(errors, slam.trajectory().at(valid), valid, slam.keyframe_indices, truth)
    loops = sum(loop.accepted for loop in slam.loops)
    return {"frames": len(slam.steps), "submaps": len(slam.atlas.anchors), "loops": loops, **found}


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table: rows for each sequence and kind of motion."""
    found = measured["figures"]["sources"]
    measured_truth = any(run.get("truth_error_m") for run in found)
    columns = [*COLUMNS, *(WITH_TRUTH if measured_truth else ())]
    rows = [cells(MOTIONS[kind], kind, [run], columns) for run in found for kind in MOTIONS]
    for row, run in zip(rows, [run for run in found for _ in MOTIONS], strict=True):
        row.insert(0, run["source"])
    noisy = [run for run in found if "noise=1" in run["source"]]
    if len(noisy) > 1:
        rows += [[POOLED, *cells(MOTIONS[kind], kind, noisy, columns)] for kind in MOTIONS]
    head = ["sequence", "motion", "motions", *(heading for heading, *_ in columns)]
    note = (
        "NEES should be 6 on average (median 5.35), k = 1 (the variances of the position are k times too small). "
        "Motions of 50 frames and from the start overlap: a run has few independent ones."
    )
    if measured_truth:
        known = {run["source"]: run for run in found if run.get("truth_error_m")}
        each = (
            f"{name} {1e3 * run['truth_error_m']:g} mm, {run['truth_error_deg']:.2g}°" for name, run in known.items()
        )
        note += f" Last columns: with the truth's own error, of each true pose, in the covariance: {'; '.join(each)}."
    return [Section("Covariance of poses", head, rows, note)]


def cells(name: str, kind: str, runs: list[dict[str, Any]], columns: list[Column]) -> list[str]:
    """Return the cells of one kind of motion, as means over the runs that have the figure."""
    scores = [run[kind] for run in runs if run[kind]]

    def mean(figure: str, factor: float) -> str:
        values = [score[figure] for score in scores if figure in score]
        return significant(factor * float(np.mean(values)) if values else None)

    return [name, str(sum(score["count"] for score in scores)), *(mean(*column[1:]) for column in columns)]


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every sequence, each in a fresh process."""
    found = []
    for s in options.sources:
        path = s if s.startswith("synthetic") else accuracy.located(s)
        found.append({"source": s if s.startswith("synthetic") else Path(s).name, **alone(measure, path, options)})
    return {"sources": found}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("pose_covariance", options, measure_all, [0])


if __name__ == "__main__":
    program.start(main, Options)
