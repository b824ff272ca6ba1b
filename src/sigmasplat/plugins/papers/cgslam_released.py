"""Presets with the values of CG-SLAM's released code: a row per scene, and the code's methods where the paper differs.

In the code, bundle adjustment moves only the newest pose, with a gradient without the path through the covariance. The
window is chosen by the similarity of NetVLAD; without a file of weights (`loops.weights`) the built-in descriptor is
used, with a warning. Uncertain splats are not pruned, the splat at the median depth owns a pixel, no splat is cloned,
and the second frame has its own number of iterations. Bugs of the code are not reproduced.
"""

from functools import partial
from typing import NamedTuple

from sigmasplat.config import Config
from sigmasplat.plugins.papers.cgslam import REPLICA, SCANNET, TUM, color_share, sized


class ReleasedScene(NamedTuple):
    """A row of the code's values.

    base: preset of the data set. Tracking: iterations, learning rates, λ1 (color), λ2 (depth). Mapping: iterations,
    interval, window, weights of colour (M_color, of which 0.1 for SSIM) and depth. extent: of the scene.
    """

    base: Config
    iterations: int
    lr_rotation: float
    lr_translation: float
    color: float
    depth: float
    map_iterations: int
    every: int
    window: int
    map_color: float
    map_depth: float
    extent: float


# The extents of Replica's room1 and office2 are 4 and 2.5. The code has no rows for other scenes.
SCENES = {
    "replica": ReleasedScene(REPLICA, 15, 1.5e-3, 2.15e-3, 0.2, 1.0, 60, 30, 4, 0.8, 0.25, 5.0),
    "fr1-desk": ReleasedScene(TUM, 50, 1.5e-3, 2.15e-3, 1.0, 0.5, 50, 15, 3, 1.0, 0.8, 2.0),
    "fr1-desk2": ReleasedScene(TUM, 50, 1.5e-3, 2.15e-3, 1.0, 0.6, 80, 10, 8, 0.9, 1.0, 2.0),
    "fr1-room": ReleasedScene(TUM, 50, 1.5e-3, 2.15e-3, 1.0, 0.6, 80, 10, 6, 0.9, 1.0, 3.0),
    "fr2-xyz": ReleasedScene(TUM, 50, 1.5e-3, 2.15e-3, 1.0, 0.6, 50, 15, 8, 1.0, 0.7, 5.0),
    "fr3-office": ReleasedScene(TUM, 50, 1.5e-3, 2.15e-3, 1.0, 0.6, 30, 15, 8, 1.0, 0.8, 5.0),
    "scene0000": ReleasedScene(SCANNET, 50, 7.5e-4, 1.15e-3, 1.0, 0.5, 50, 15, 10, 1.0, 0.7, 2.0),
    "scene0059": ReleasedScene(SCANNET, 50, 2.5e-3, 2.15e-3, 1.0, 0.5, 50, 5, 10, 1.0, 0.8, 2.0),
    "scene0106": ReleasedScene(SCANNET, 50, 2.5e-3, 2.15e-3, 0.8, 1.0, 50, 5, 3, 1.0, 1.0, 2.0),
    "scene0169": ReleasedScene(SCANNET, 50, 2.5e-3, 2.15e-3, 1.0, 0.5, 50, 15, 8, 1.0, 0.7, 3.0),
    "scene0181": ReleasedScene(SCANNET, 50, 2.5e-3, 2.15e-3, 1.0, 0.8, 50, 5, 10, 1.0, 1.0, 2.0),
    "scene0207": ReleasedScene(SCANNET, 50, 2.5e-3, 2.15e-3, 1.0, 0.8, 50, 15, 10, 1.0, 0.7, 2.0),
}
OTHER_RATES = {"fr1-room": {"first": 1.6e-4, "last": 4e-5}, "fr3-office": {"log_scales": 1e-3}}


def _released(scene: ReleasedScene, **rates: float) -> Config:
    """Return the settings of a scene as in the code, with the code's methods."""
    s = scene
    config = s.base.changed(
        mapping={
            "every": s.every, "iterations": s.map_iterations, "window": s.window, "covisibility": "descriptor",
            "weight_l1": s.map_color - 0.1, "weight_depth": s.map_depth, "weight_alignment": 0.25,
            "weight_moment": 0.15, "poses": "newest",
        },
        tracking={
            "iterations": s.iterations, "lr_rotation": s.lr_rotation, "lr_translation": s.lr_translation,
            "weight_color": color_share(s.color, s.depth), "first_iterations": 200, "first_lr_rotation": 3e-3,
        },
        render={"covariance_pose_gradient": False},
        primitives={"uncertain_m2": 0.0, "owner": "median", "clone": False},
        loops={"descriptor": "netvlad-or-grid"},
    )  # fmt: skip
    return sized(config, s.extent, **rates)


PRESETS = {
    f"cgslam-released-{name}": partial(_released, scene, **OTHER_RATES.get(name, {})) for name, scene in SCENES.items()
}
