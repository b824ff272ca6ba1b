"""Measure whether the uncertainty rule cuts submaps where tracking is weak (VarSplat §2, issues 4 and 18).

Runs SLAM with `submaps.uncertainty_m` (the covariance of tracking) as the only rule. Compares the motion from each
keyframe to the next (a hop) with the ground truth, where the rule fires and where it does not, and ranks the hops by
what they add to the covariance.
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

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.data import se3
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.metrics.uncertainty import spearman
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
ADDED = {"covariance": "added_m2", "V": "variance"}
"""What a hop adds to the value of each rule; V in earlier results only."""


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
    settings: Settings = ()
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    name: Annotated[str, arg(help="name of the results")] = "drift-rule"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(path: str, options: Options) -> list[dict[str, Any]]:
    """Run one sequence; return its hops and the number of submaps. Raises SourceError if it cannot be read."""
    config = override(preset_of(options.preset), split_settings(options.settings))
    rule = replace(config.submaps, uncertainty_m=options.uncertainty_m, distance_m=0.0, frames=0)
    found = followed(path, replace(config, submaps=rule), options.limit)
    return [{"rule": "covariance", "limit": options.uncertainty_m, **found}]


def followed(path: str, config: Config, limit: int | None) -> dict[str, Any]:
    """Run one sequence with given settings, without loops; return its hops, its frames and its number of submaps."""
    config = replace(config, loops=replace(config.loops, close=False))
    source, slam = open_source(path, config.input, limit=limit or config.input.limit), Slam(config)
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
    """Return each hop: its last frame, its submap, what it adds to δ² (m²), whether a submap ended, and the true
    error, m."""
    hops = []
    for before, after in pairwise(slam.keyframe_indices):
        if before not in known or after not in known:
            continue
        estimate, truth = (se3.inverse(p[before]) @ p[after] for p in (path, known))
        submap = slam.steps[before].submap
        drift = [slam.steps[k].tracking.get("drift_m", 0.0) for k in (before, after)]
        if before == 0 or (before - 1 >= 0 and slam.steps[before - 1].submap != submap):
            drift[0] = 0.0  # the submap begins with this keyframe
        hops.append(
            {
                "frame": after,
                "submap": submap,
                "drift_m": round(drift[1], 6),
                "added_m2": drift[1] ** 2 - drift[0] ** 2,
                "cut": slam.steps[after].submap != submap,
                "error_m": round(float(np.linalg.norm((se3.inverse(truth) @ estimate)[:3, 3])), 6),
            }
        )
    return {"hops": hops, "submaps": len(slam.atlas.anchors)}


# ---- tables ----


Rows = list[dict[str, Any]]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table: a row for each sequence and rule."""
    rows = []
    for found in measured["figures"]["sources"]:
        hops: Rows = found["hops"]
        rule = found.get("rule", "covariance")
        errors_cm = {cut: [100 * hop["error_m"] for hop in hops if hop["cut"] is cut] for cut in (True, False)}
        counts = [str(len(hops)), str(found["submaps"]), str(found["lost"])]
        cells = [level(errors_cm[cut], share) for cut in (True, False) for share in (0.5, 0.9)]
        rows.append([found["source"], rule, *counts, *cells, rank(hops, ADDED[rule])])
    head = ["sequence", "rule", "hops", "submaps", "lost frames", "error of hops where the rule fires, cm: median"]
    head += ["… 90 %", "where it does not fire, cm: median", "… 90 %", "Spearman of added uncertainty and error"]
    limit_cm = significant(100 * measured["config"]["uncertainty_m"])
    note = (
        f"Rule *covariance*: a submap ends where the camera's position in it is uncertain by more than {limit_cm} cm. "
        "Rule *V*, which is gone: it ended where the sum of the mean V of the tracked frames exceeded a limit. "
        "Hops lead from keyframe to keyframe; errors are relative to the ground truth, which no rule uses. "
        "Spearman: rank correlation of the error of a hop with what it adds to the rule's value."
    )
    return [Section("Uncertainty rule", head, rows, note)]


def rank(hops: Rows, added: str) -> str:
    """Return the rank correlation of what hops add to a rule's value with their errors; a dash if it is not known."""
    known = [(hop[added], hop["error_m"]) for hop in hops if added in hop and np.isfinite(hop[added])]
    return significant(float(spearman(*np.array(known).T)), 2) if len(known) > 2 else "–"


def level(errors: list[float], share: float) -> str:
    """Return the quantile `share` of the errors; a dash without errors."""
    return significant(float(np.quantile(errors, share))) if errors else "–"


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every sequence."""
    found = [{"source": Path(s).name, **run} for s in options.sources for run in measure(accuracy.located(s), options)]
    return {"sources": found}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("drift_rule", options, measure_all, [0])


if __name__ == "__main__":
    program.start(main, Options)
