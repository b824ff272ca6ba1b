"""Presets with the values and methods of the papers' released code, by scene: rows of the tables in `scenes/`. Mistakes
of the code are not reproduced, such as another camera's calibration for fr3; deviations: docs/varsplat.md.

VarSplat: the colours of all splats are frozen in the first half of a keyframe's steps: pruning makes them trainable
again. Adam starts anew at each keyframe, the pose's Adam is AMSGrad, and tau of registration is 3 in all scenes (the
arguments are given by position, so w_max is used as tau).

CG-SLAM: bundle adjustment moves only the newest pose, with a gradient without the path through the covariance. The
window is chosen by the similarity of NetVLAD; without a file of weights (`loops.weights`) the built-in descriptor is
used, with a warning. Uncertain splats are not pruned, no splat is cloned, and the second frame has its own iterations.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from sigmasplat.api import Config, ConfigError, Preset, nearest
from sigmasplat.plugins.presets import cgslam, varsplat
from sigmasplat.plugins.presets.shared_by_papers import read_values

CODE = read_values("values/released_code")


def _varsplat(row: dict[str, Any]) -> Config:
    """Return the settings of a scene of VarSplat's code."""
    like: str = row["like"]
    return varsplat.DATASETS[like].changed(**CODE["varsplat"]).changed(**CODE[f"varsplat-{like}"]).changed(
        input={"crop_px": row["crop_px"]},
        mapping={"weight_nll_depth": 1e-4 if row["nll_depth"] else 0.0},
        tracking={"tau": row["tau_tracking"]}, loops={"tau": row["tau_loops"]},
    )  # fmt: skip


def _cgslam(row: dict[str, Any]) -> Config:
    """Return the settings of a scene of CG-SLAM's code."""
    row = CODE["cgslam-usual"] | row
    config = cgslam.DATASETS[row["like"]].changed(**CODE["cgslam"]).changed(
        mapping={
            "every": row["every"], "iterations": row["map_iterations"], "window": row["window"],
            "weight_l1": row["map_color"] - 0.1, "weight_depth": row["map_depth"],
        },
        tracking={name: row[name] for name in ("iterations", "lr_rotation", "lr_translation")}
        | {"weight_color": row["color"] / (row["color"] + row["depth"])},
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
