"""Rewrite an RGB-D image as if all its rows had been read at once, in the middle of its colour."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import Readout
from sigmasplat.env import opencv
from sigmasplat.types import Matrix

ROUNDS = 2
"""What is read at a pixel depends on where its point was then; so often is it looked up."""
SAME_SURFACE = 0.03
"""Readings of one surface differ by less than this share, as in alignment (native/align_pixel.h)."""
PIXEL_AND_NEXT = np.ones((2, 2), np.uint8)
Image = NDArray[Any]


def read_at_once(frame: Frame, readout: Readout) -> Frame:
    """Return the frame with colour [H, W, 3] and depth [H, W] as the camera sees them in the middle of its colour.

    Each pixel is looked up where its point was when its row was read; its motion is that of `readout.rate`, to first
    order. Pixels without depth move as those at the median depth.
    """
    cv2 = opencv()
    c, depth_m, z = frame.camera, frame.depth_m, frame.depth_m
    usual_m = np.float32(np.median(depth_m[depth_m > 0]) if (depth_m > 0).any() else 1.0)
    row = np.arange(c.height, dtype=np.float64)[:, None]
    late_s, color_s = (read_s(row, c.height).astype(np.float32) for read_s in (readout.depth_s, readout.color_s))
    for _ in range(ROUNDS):
        at = _seen_at(c, np.where(z > 0, z, usual_m), readout.rate, late_s)
        read_m = _between_readings(depth_m, *at)
        z = np.where(read_m > 0, _moved(_points(c, *at, read_m), readout.rate, -late_s)[2], np.float32(0.0))
    at = _seen_at(c, np.where(z > 0, z, usual_m), readout.rate, color_s)
    color = cv2.remap(frame.color, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0.0, 1.0)
    return replace(frame, color=color, depth_m=np.maximum(z, np.float32(0.0)))


def _between_readings(depth_m: Image, column: Image, row: Image) -> Image:
    """Return the depth [H, W] at some columns and rows: interpolated on a surface, that of the nearest pixel at its
    edge and beside a hole, 0 beyond the image."""
    cv2 = opencv()
    nearest_m = cv2.remap(depth_m, column, row, cv2.INTER_NEAREST)
    between_m = cv2.remap(depth_m, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    least_m, most_m = (extreme(depth_m, PIXEL_AND_NEXT, anchor=(0, 0)) for extreme in (cv2.erode, cv2.dilate))
    whole: Image = (most_m - least_m < SAME_SURFACE * least_m).astype(np.float32)
    whole = cv2.remap(whole, np.floor(column), np.floor(row), cv2.INTER_NEAREST)
    return np.asarray(np.where((whole > 0) & (nearest_m > 0), between_m, nearest_m))


def _points(camera: Camera, column: Image, row: Image, z: Image) -> tuple[Image, Image, Image]:
    fx, fy, cx, cy = _intrinsics(camera)
    return (column - cx) * (z / fx), (row - cy) * (z / fy), z


def _intrinsics(camera: Camera) -> Image:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)


def _moved(point: tuple[Image, Image, Image], rate: Matrix, late_s: Image) -> tuple[Image, Image, Image]:
    """Return points in the camera after it has moved for late_s [H, 1], to first order."""
    (x, y, z), (a, b, c, u, v, w) = point, rate.astype(np.float32)
    return x - late_s * (a + v * z - w * y), y - late_s * (b + w * x - u * z), z - late_s * (c + u * y - v * x)


def _seen_at(camera: Camera, z: Image, rate: Matrix, late_s: Image) -> tuple[Image, Image]:
    """Return the column and row at which the points of the pixels at depth z [H, W] were read, late_s [H, 1] after the
    middle of the colour: rows move by so little that their own time serves."""
    rows_columns: Image = np.indices(z.shape, np.float32)
    x, y, ahead = _moved(_points(camera, rows_columns[1], rows_columns[0], z), rate, late_s)
    (fx, fy, cx, cy), ahead = _intrinsics(camera), np.maximum(ahead, np.float32(1e-3))
    return fx * x / ahead + cx, fy * y / ahead + cy
