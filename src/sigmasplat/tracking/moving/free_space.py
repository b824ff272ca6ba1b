"""Find the points in space that a depth image sees to be free: all its readings around them are farther. Least and
largest readings in windows, connected regions, and a quick median: OpenCV needs a twentieth of SciPy's time for the
first, and less than SciPy for the second."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
from sigmasplat.native import _core
from sigmasplat.types import Matrix

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.floating]

CLEAR_M, CLEAR_RELATIVE = 0.05, 0.05
"""A place was free if the reference saw a surface farther than it by this distance plus this share of its depth; the
share alone tells neighbouring pixels of two surfaces apart."""
AROUND_PX = 5
"""Least size of the window around a pixel of the reference in which all readings must be farther: poses have errors."""


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


def least_around(depth_m: Depth, size: int) -> Depth:
    """Return the least reading in a window of `size` pixels around each pixel [H, W], inf without any."""
    read = np.where(depth_m > 0, depth_m, np.float32(np.inf))
    return np.asarray(opencv().erode(read, _window(size), borderType=opencv().BORDER_REPLICATE), np.float32)


def largest_around(depth_m: Depth, size: int) -> Depth:
    """Return the largest reading in a window of `size` pixels around each pixel [H, W], 0 without any."""
    return np.asarray(opencv().dilate(np.ascontiguousarray(depth_m), _window(size)), np.float32)


def widened(mask: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """Return a mask [H, W] with all pixels whose window of `size` pixels touches it."""
    return np.asarray(opencv().dilate(np.ascontiguousarray(mask).view(np.uint8), _window(size)).view(np.bool_))


def labelled(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the number of the connected region of each pixel [H, W], from 1 on in the order of rows, 0 outside of the
    mask; and left, top, width, height and size of each region [count, 5], in pixels. Regions connect at corners too."""
    cv2, image = opencv(), np.ascontiguousarray(mask).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(image, 8, cv2.CV_32S, cv2.CCL_SAUF)
    return np.asarray(labels, np.int32), np.asarray(stats[1:], np.int32)


def largest_label(labels: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """Return the largest label in a window of 3 pixels around each pixel [H, W]; labels are at most `count` ≤ 2²⁴."""
    exact = np.uint16 if count <= np.iinfo(np.uint16).max else np.float32
    return np.asarray(opencv().dilate(labels.astype(exact), _window(3)), np.int32)


def upper_median(values: Depth) -> np.float32:
    """Return the median of values [n], n > 0, the larger one of two: `np.median` needs twice the time."""
    middle = len(values) // 2
    return np.float32(np.partition(values, middle)[middle])


def _window(size: int) -> NDArray[np.uint8]:
    return np.ones((size, size), np.uint8)
