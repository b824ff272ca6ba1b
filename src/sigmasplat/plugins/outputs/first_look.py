"""Choose what people see first of a map: the view to open it with, and the splats that are sure enough to show."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sigmasplat.api import GaussianField, MapUncertainty, Matrix
from sigmasplat.plugins.outputs.floorplan.ground import SurfaceSample

SURE = 0.05
"""Largest standard deviation of depth of a shown splat, as a share of its distance from the nearest camera. From 30°
aside, such an error moves a splat by 1.4°: it no longer lies on the object that it belongs to."""
VIEWS = 24
"""The first view is chosen from so many, evenly spaced (`sample_surfaces`)."""


def sure(field: GaussianField, known: MapUncertainty | None, positions: Matrix) -> Tensor:
    """Return the splats that are shown by default, bool [N]: all, if the run has not measured how sure they are.

    positions: of the cameras [F, 3] m, in the map's frame.
    """
    if known is None or known.std is None or not len(positions):
        return torch.ones(len(field), dtype=torch.bool)
    distance_m, _ = cKDTree(positions).query(field.means.cpu().numpy())
    return known.std.depth_std_m.cpu() <= SURE * torch.from_numpy(distance_m)


def best_view(samples: Sequence[SurfaceSample]) -> int:
    """Return which of the views to open a map with: the one that sees the largest area of the splats that are shown.

    A pixel counts with the area (z/f)² that it covers at its depth z, and the whole view with the cosine of its roll.
    """
    down = np.mean([sample.T_world_camera[:3, 1] for sample in samples], axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)

    def shown(sample: SurfaceSample) -> float:
        right, _, ahead, position = sample.T_world_camera[:3].T
        area = float((((sample.points - position) @ ahead) ** 2).sum())
        return area * float(np.sqrt(max(1.0 - (right @ down) ** 2, 0.0)))

    return int(np.argmax([shown(sample) for sample in samples]))
