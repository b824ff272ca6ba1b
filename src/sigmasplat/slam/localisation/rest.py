"""Notice that what was moving has come to rest: from then on it is part of the scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.slam.localisation.foreground import CLEAR_M, CLEAR_RELATIVE, Foreground, projected
from sigmasplat.types import Matrix

STEP = 4
MOVED = 0.1
"""It has moved if this share of it is in space that was free before, or left such space."""
AROUND_PX = 3


@dataclass(frozen=True, eq=False)
class Rest:
    """How long something stays in its place: the frames since it came there, the depth [H, W] m of the frame in which
    it came, what of this was in front [H, W], and T_world_camera [4, 4] of that frame."""

    frames: int
    depth_m: NDArray[np.float32]
    in_front: NDArray[np.bool_]
    T_world_camera: Matrix

    def seen(self, front: Foreground, depth_m: NDArray[np.float32], T_world_camera: Matrix, camera: Camera) -> "Rest":
        """Return the rest after another frame: it is one frame longer, or begins again if the object has moved."""
        T_then_now = se3.inverse(self.T_world_camera) @ T_world_camera
        came = _through(front.depth_m > 0, depth_m, self.depth_m, T_then_now, camera)
        left = _through(self.in_front, self.depth_m, depth_m, se3.inverse(T_then_now), camera)
        if max(came, left) > MOVED:
            return begun(front, depth_m, T_world_camera)
        return Rest(self.frames + 1, self.depth_m, self.in_front, self.T_world_camera)

    def moved_by(self, T_new_old: Matrix) -> "Rest":
        """Return the same rest in other coordinates [4, 4]."""
        return Rest(self.frames, self.depth_m, self.in_front, T_new_old @ self.T_world_camera)


def begun(front: Foreground, depth_m: NDArray[np.float32], T_world_camera: Matrix) -> Rest:
    """Return the rest of something that has just moved to its place."""
    return Rest(0, depth_m, front.depth_m > 0, T_world_camera)


def _through(
    chosen: NDArray[np.bool_], own_m: NDArray[np.float32], other_m: NDArray[np.float32], T_other_own: Matrix,
    camera: Camera,
) -> float:  # fmt: skip
    """Return the share of the chosen pixels of one image whose places the other one sees to be free."""
    v, u = (STEP * index for index in np.nonzero((chosen & (own_m > 0))[::STEP, ::STEP]))
    if not len(v):
        return 0.0
    points = camera.rays()[v, u].T.astype(np.float64) * own_m[v, u]
    inside, row, column, z = projected(points, camera, T_other_own)
    near = minimum_filter(np.where(other_m > 0, other_m, np.float32(np.inf)), AROUND_PX)
    known = inside & (maximum_filter(other_m, AROUND_PX)[row, column] > 0)
    return float((known & (z * (1 + CLEAR_RELATIVE) + CLEAR_M < near[row, column])).sum() / max(known.sum(), 1))
