"""Find the points in space that a depth image sees to be free: all its readings around them are farther."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.native import _core
from sigmasplat.types import Matrix

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.floating]

CLEAR_M, CLEAR_RELATIVE = 0.05, 0.05
"""A place was free if the reference saw a surface farther than it by this distance plus this share of its depth."""
AROUND_PX = 5
"""Least size of the window around a pixel of the reference in which all readings must be farther: the pose is not
exact."""


def free_places(
    points_m: Depth, T_camera_points: Matrix, depth_m: Depth, camera: Camera, clear_m: float = CLEAR_M,
    further_px: int = 0,
) -> Mask:  # fmt: skip
    """Return which points [3, n] m, float32, are in space that a depth image [H, W] m of a camera sees to be free.

    T_camera_points [4, 4]: the pose of their frame; further_px: the window around each pixel is larger by so many
    pixels on each side. Without a reading in the window, nothing is known.
    """
    c, free = camera, np.empty(points_m.shape[1], np.uint8)
    T, depth = np.ascontiguousarray(T_camera_points, np.float64), np.ascontiguousarray(depth_m)
    radius_px = AROUND_PX // 2 + further_px
    _core.free_places(points_m, T, depth, [c.fx, c.fy, c.cx, c.cy], radius_px, clear_m, CLEAR_RELATIVE, free)
    return free.view(np.bool_)


def on_image(x: Floats, y: Floats, z: Floats, camera: Camera) -> tuple[Mask, NDArray[np.intp], NDArray[np.intp]]:
    """Return whether points x, y, z [n] m in a camera's frame are in its image; their row and column (0 outside)."""
    ahead = np.maximum(z, 1e-3)
    column, row = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = (z > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    row, column = (np.where(inside, pixel, 0) for pixel in (row, column))
    return np.asarray(inside), row.astype(np.intp), column.astype(np.intp)
