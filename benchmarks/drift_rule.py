"""Measure whether the uncertainty rule cuts submaps where tracking is weak (VarSplat §2, issue 4).

Runs SLAM with `submaps.uncertainty_m` as the only rule. Compares the motion from each keyframe to the next (a hop) with
the ground truth, where the rule fires and where it does not.
Writes benchmarks/results/drift_rule-<machine>.json and prints tables.

example: python benchmarks/drift_rule.py --sources hololens --limit 120
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from numpy.typing import NDArray
from tables import Section, significant

from sigmasplat.config import SubmapConfig
from sigmasplat.metrics.trajectory import associate
from sigmasplat.model import se3
from sigmasplat.presets import default_preset, preset as preset_of
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import open_source

arg = tyro.conf.arg
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Cut submaps by accumulated uncertainty only, and measure the true error there."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "livingroom",
        "redkitchen",
        "hololens",
    )
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    uncertainty_m: Annotated[float, arg(help="limit of the rule, metres")] = 0.02
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    name: Annotated[str, arg(help="name of the results")] = "drift-rule"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(path: str, options: Options) -> dict[str, Any]:
    """Run one sequence; return its hops and its number of submaps. Raises SourceError if it cannot be read."""
    config = preset_of(options.preset)
    rule = SubmapConfig(uncertainty_m=options.uncertainty_m, inherit=config.submaps.inherit)
    config = replace(config, submaps=rule, loops=replace(config.loops, close=False))
    source, slam = open_source(path, limit=options.limit), Slam(config)
    for frame in source:
        slam.step(frame)
    truth = source.truth()
    assert truth is not None, f"{path} has no ground truth"
    rows, true_rows = associate(np.array([step.timestamp_s for step in slam.steps]), truth.timestamps_s)
    known = dict(zip(rows.tolist(), truth.T_world_camera[true_rows], strict=True))
    path_ = slam.trajectory().T_world_camera
    lost = [step.index for step in slam.steps if step.lost]
    return {"frames": len(path_), "lost": len(lost), **hops_of(slam, path_, known)}


def hops_of(slam: Slam, path: Matrix, known: dict[int, Matrix]) -> dict[str, Any]:
    """Return each hop: its last frame, its submap, the uncertainty there, whether a submap ended, the true error, m."""
    hops = []
    for before, after in pairwise(slam.keyframe_indices):
        if before not in known or after not in known:
            continue
        estimate, truth = (se3.inverse(p[before]) @ p[after] for p in (path, known))
        submap = slam.steps[before].submap
        hops.append(
            {
                "frame": after,
                "submap": submap,
                "drift_m": round(slam.steps[after].tracking["drift_m"], 6),
                "cut": slam.steps[after].submap != submap,
                "error_m": round(float(np.linalg.norm((se3.inverse(truth) @ estimate)[:3, 3])), 6),
            }
        )
    return {"hops": hops, "submaps": len(slam.atlas.anchors)}


# ---- tables ----


Rows = list[dict[str, Any]]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table: a row for each sequence."""
    rows = []
    for found in measured["figures"]["sources"]:
        hops: Rows = found["hops"]
        errors_cm = {cut: [100 * hop["error_m"] for hop in hops if hop["cut"] is cut] for cut in (True, False)}
        counts = [str(len(hops)), str(found["submaps"]), str(found["lost"])]
        cells = [level(errors_cm[cut], share) for cut in (True, False) for share in (0.5, 0.9)]
        rows.append([found["source"], *counts, *cells])
    head = ["sequence", "hops", "submaps", "lost frames", "error of hops where the rule fires, cm: median", "… 90 %"]
    head += ["where it does not fire, cm: median", "… 90 %"]
    limit_cm = significant(100 * measured["config"]["uncertainty_m"])
    note = (
        f"A submap ends where the camera's position in it is uncertain by more than {limit_cm} cm. Hops lead from "
        "keyframe to keyframe; errors are relative to the ground truth, which the rule does not use."
    )
    return [Section("Uncertainty rule", head, rows, note)]


def level(errors: list[float], share: float) -> str:
    """Return the quantile `share` of the errors; a dash without errors."""
    return significant(float(np.quantile(errors, share))) if errors else "–"


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every sequence."""
    found = [{"source": Path(s).name, **measure(accuracy.located(s), options)} for s in options.sources]
    return {"sources": found}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("drift_rule", options, measure_all, [0])


if __name__ == "__main__":
    program.start(main, Options)
