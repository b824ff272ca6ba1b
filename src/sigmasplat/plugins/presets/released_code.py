"""Presets with the values of the papers' released code, by scene: rows of the tables in `scenes/`, and the code's
methods where the paper differs. Mistakes of the code are not reproduced, such as the calibration of another camera for
fr3.

VarSplat: the colours of all splats are frozen in the first half of a keyframe's steps: pruning makes them trainable
again. Adam starts anew at each keyframe, the pose's Adam is AMSGrad, and tau of registration is 3 in all scenes (the
arguments are given by position, so w_max is used as tau). Deviations: docs/varsplat.md.

CG-SLAM: bundle adjustment moves only the newest pose, with a gradient without the path through the covariance. The
window is chosen by the similarity of NetVLAD; without a file of weights (`loops.weights`) the built-in descriptor is
used, with a warning. Uncertain splats are not pruned, no splat is cloned, and the second frame has its own number of
iterations.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from sigmasplat.api import Config, ConfigError, Preset, nearest
from sigmasplat.plugins.presets import cgslam, varsplat
from sigmasplat.plugins.presets.shared_by_papers import read_values

# min_interval: the code's limit + 1, because it asks for more than the limit. max_depth_m: no reading is removed, the
# PNGs of TUM and ScanNet end at 13 and 66 m.
VARSPLAT_DATA: dict[str, dict[str, dict[str, Any]]] = {
    "replica": {"loops": {"min_interval": 3}, "input": {"max_depth_m": 10.0}},
    "tum": {"loops": {"min_interval": 4}, "input": {"max_depth_m": 13.5}},
    "scannet": {
        "loops": {"min_interval": 5}, "input": {"max_depth_m": 66.0}, "registration": {"method": "rendered"},
    },
    "scannetpp": {"loops": {"min_interval": 2}, "input": {"max_depth_m": 66.0, "limit": 250}},
}  # fmt: skip


def _varsplat(row: dict[str, Any]) -> Config:
    """Return the settings of a scene of VarSplat's code."""
    like: str = row["like"]
    base = varsplat.DATASETS[like]
    return base.changed(**VARSPLAT_DATA[like]).changed(
        input={"crop_px": row["crop_px"]},
        seeding={"outliers": "remove-later" if base.seeding.outliers == "remove" else "keep"},
        mapping={
            "colors": "code",
            "weight_nll_depth": 1e-4 if row["nll_depth"] else 0.0,
        },
        tracking={"descent": "amsgrad", "tau": row["tau_tracking"]},
        submaps={"uncertainty_m": 0.0},
        loops={"most": 0, "tau": row["tau_loops"]},
        registration={"tau": 3.0},
        final={"schedule": "falling"},
    )  # fmt: skip


def _cgslam(row: dict[str, Any]) -> Config:
    """Return the settings of a scene of CG-SLAM's code."""
    config = cgslam.DATASETS[row["like"]].changed(
        mapping={
            "every": row["every"], "iterations": row["map_iterations"], "window": row["window"],
            "adjustment": "window-newest", "weight_l1": row["map_color"] - 0.1, "weight_depth": row["map_depth"],
            "weight_alignment": 0.25, "weight_moment": 0.15,
        },
        tracking={
            "iterations": row["iterations"], "lr_rotation": row["lr_rotation"],
            "lr_translation": row["lr_translation"],
            "weight_color": row["color"] / (row["color"] + row["depth"]), "descent": "axis-angle-start",
        },
        render={"covariance_pose_gradient": False},
        primitives={"uncertain_m2": 0.0, "densify": "split"},
        loops={"descriptor": "netvlad-or-grid"},
    )  # fmt: skip
    rates = dict(zip(("first", "last"), row.get("lr_means", ()), strict=False))
    rates |= {"log_scales": row["lr_log_scales"]} if "lr_log_scales" in row else {}
    return cgslam.sized(config, row["extent"], **rates)


def _released(paper: str, make: Callable[[dict[str, Any]], Config], scene: str) -> Config:
    """Return the settings of a scene. Raises ConfigError if the table has no such scene."""
    known = read_values(f"scenes/{paper}")
    if scene not in known:
        what = f"no scene {scene!r}{nearest(scene, known)}" if scene else "no scene"
        raise ConfigError(f"{what} in preset {paper}-released-SCENE; known: {', '.join(known)}")
    return make(known[scene])


PLUGIN = tuple(
    Preset(f"{paper}-released", partial(_released, paper, make), partial(read_values, f"scenes/{paper}"))
    for paper, make in (("cgslam", _cgslam), ("varsplat", _varsplat))
)
