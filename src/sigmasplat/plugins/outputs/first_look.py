"""Choose what people see first of a map: the keyframe to open it with, and the splats that are sure enough to show."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sigmasplat.api import Camera, GaussianField, Matrix, SplatStd, evenly_spread, se3
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, Renderer

SURE = 0.05
"""Largest standard deviation of depth of a shown splat, as a share of its distance from the nearest camera. From 30°
aside, such an error moves a splat by 1.4°: it no longer lies on the object that it belongs to."""
VIEWS, WIDTH_PX = 24, 96
"""The keyframe is chosen from so many, evenly spread, by images so wide."""


def sure(field: GaussianField, std: SplatStd | None, positions: Matrix) -> Tensor:
    """Return the splats that are shown by default, bool [N]: all, if the run has not measured how sure they are.

    positions: of the cameras [F, 3] m, in the map's frame.
    """
    if std is None or not len(positions):
        return torch.ones(len(field), dtype=torch.bool)
    distance_m, _ = cKDTree(positions).query(field.means.cpu().numpy())
    return std.depth_std_m.cpu() <= SURE * torch.from_numpy(distance_m)


def best_view(field: GaussianField, poses: Sequence[Matrix], camera: Camera, renderer: Renderer) -> int:
    """Return which of the poses T_world_camera [4, 4] to open a map with: the one that sees the largest area.

    A pixel counts with the area (z/f)² that it covers at its depth z, and the whole view with the cosine of its roll.
    field: of the splats that are shown. All poses can be given; `VIEWS` of them, evenly spread, are compared.
    """
    small = camera.resized(WIDTH_PX, max(2, round(camera.height * WIDTH_PX / camera.width)))
    right = np.array([T[:3, 0] for T in poses])
    down = np.mean([T[:3, 1] for T in poses], axis=0)
    level = np.sqrt(np.clip(1.0 - (right @ down / max(float(np.linalg.norm(down)), 1e-9)) ** 2, 0.0, 1.0))
    rows = evenly_spread(range(len(poses)), VIEWS)
    with torch.inference_mode():
        seen = [renderer(field, small, se3.inverse(poses[row])) for row in rows]
    covered = [view.alpha > COVERED_ALPHA for view in seen]
    area = np.array([float((v.depth[c] / v.alpha[c]).square().sum()) for v, c in zip(seen, covered, strict=True)])
    return rows[int(np.argmax(area * level[rows]))]
