"""Give features a position in space from a depth image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.tracking.features.base import Features
from sigmasplat.types import Matrix

NOISE_RELATIVE_PER_M = 0.003
"""Standard deviation of a depth reading, times z² (m), as in `fit.align` (Khoshelham & Elberink 2012)."""
STEP_SHARE = 0.03
"""A reading is at a depth step if the 3×3 readings around it differ by more than this share of the depth."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Features with a position in space, in the frame of the camera that saw them.

    points_m [N, 3]; sigma_m [N]: standard deviation of the depth; weight [N]: factor on the information of a landmark,
    0 to 1.
    """

    features: Features
    points_m: Matrix
    sigma_m: Matrix
    weight: Matrix

    def __len__(self) -> int:
        return len(self.features)


def landmarks_of(
    features: Features, depth_m: NDArray[np.float32], depth_camera: Camera, weights: NDArray[np.floating] | None = None
) -> Landmarks:
    """Return the features that have a depth reading away from depth steps, with their positions.

    depth_m [h, w] and weights [h, w] (all 1 if None) are images of `depth_camera`, which may have another size and
    crop than the camera of the features, but the same pose.
    """
    z = depth_readings(features, depth_m, depth_camera)
    kept = z > 0
    some, z = features.take(kept), z[kept]
    c = some.camera
    u, v = some.points.T.astype(np.float64)
    points = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], 1)
    column, row, _ = _pixels(some, depth_camera)
    weight = np.ones(len(z)) if weights is None else np.asarray(weights[row, column], np.float64)
    return Landmarks(some, points, depth_sigma_m(z), weight)


def depth_readings(features: Features, depth_m: NDArray[np.float32], depth_camera: Camera) -> Matrix:
    """Return the depth of each feature [N], metres: the reading of the nearest pixel; 0 = no reading, or a depth
    step."""
    column, row, inside = _pixels(features, depth_camera)
    padded = np.pad(np.asarray(depth_m, np.float64), 1)
    around = np.stack([padded[row + i, column + k] for i in range(3) for k in range(3)])
    z = around[4]
    low = np.where(around > 0, around, np.inf).min(0)
    smooth = around.max(0) - low <= STEP_SHARE * z
    return np.where(inside & (z > 0) & smooth, z, 0.0)


def depth_sigma_m(z: Matrix) -> Matrix:
    """Return the standard deviation of depth readings, metres."""
    return NOISE_RELATIVE_PER_M * z * z + 1e-3


def _pixels(features: Features, camera: Camera) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return column and row of the nearest pixel of `camera` for each feature, clipped to the image, and whether it is
    inside."""
    c = features.camera
    u, v = features.points.T.astype(np.float64)
    column = np.rint((u - c.cx) / c.fx * camera.fx + camera.cx).astype(np.intp)
    row = np.rint((v - c.cy) / c.fy * camera.fy + camera.cy).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return column.clip(0, camera.width - 1), row.clip(0, camera.height - 1), inside
