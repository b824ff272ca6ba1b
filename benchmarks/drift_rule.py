"""Ask whether the uncertainty rule cuts submaps where tracking is weak (VarSplat §2, issue 4).

Runs SLAM with `submaps.uncertainty_m` as the only rule and holds every hop from keyframe to keyframe against the truth:
how far its pose is truly off where the rule fires and where it does not.
Writes benchmarks/results/drift_rule-<machine>.json and prints tables.

example: python benchmarks/drift_rule.py --sources hololens --limit 120
"""

import sys
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import record
import tables
import tyro
from numpy.typing import NDArray

from sigmasplat.config import SubmapConfig
from sigmasplat.errors import SigmaSplatError
from sigmasplat.metrics.trajectory import associate
from sigmasplat.model import se3
from sigmasplat.presets import default_preset, preset as preset_of
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import open_source

arg = tyro.conf.arg
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Cut submaps by accumulated uncertainty alone, and look where that is."""

    sources: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = (
        "livingroom",
        "redkitchen",
        "hololens",
    )
    preset: Annotated[str, arg(help="settings to start from")] = default_preset()
    uncertainty_m: Annotated[float, arg(help="limit of the rule")] = 0.02
    limit: Annotated[int | None, arg(help="take at most so many frames")] = None
    name: Annotated[str, arg(help="name of the results")] = "drift-rule"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(path: str, options: Options) -> dict[str, Any]:
    """Run one sequence; return its hops and its submaps. Raises SourceError if it cannot be read or has no truth."""
    config = preset_of(options.preset)
    rule = SubmapConfig(uncertainty_m=options.uncertainty_m, inherit=config.submaps.inherit)
    config = replace(config, submaps=rule, loops=replace(config.loops, close=False))
    source, slam = open_source(path, limit=options.limit), Slam(config)
    for frame in source:
        slam.step(frame)
    truth = source.truth()
    assert truth is not None, f"{path} has no truth"
    rows, true_rows = associate(np.array([step.timestamp_s for step in slam.steps]), truth.timestamps_s)
    known = dict(zip(rows.tolist(), truth.T_world_camera[true_rows], strict=True))
    path_ = slam.trajectory().T_world_camera
    lost = [step.index for step in slam.steps if step.lost]
    return {"frames": len(path_), "lost": len(lost), **hops_of(slam, path_, known)}


def hops_of(slam: Slam, path: Matrix, known: dict[int, Matrix]) -> dict[str, Any]:
    """Return each hop: the frame it leads to, its submap, the uncertainty there, was it cut, its true error, m."""
    hops = []
    for before, after in pairwise(slam.keyframes):
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


def main(options: Options) -> int:
    """Measure, write, print; exit code 2 if the options mean nothing."""
    found = []
    try:
        for source in options.sources:
            found.append({"source": Path(source).name, **measure(accuracy.located(source), options)})
    except SigmaSplatError as problem:
        print(f"drift_rule.py: {problem}", file=sys.stderr)
        return 2
    config = {name: value for name, value in asdict(options).items() if name != "out"}
    measured = record.results("drift_rule", {"sources": found}, name=options.name, seeds=[0], config=config)
    print(record.write(measured, options.out), file=sys.stderr)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, config=(tyro.conf.FlagCreatePairsOff,))))
