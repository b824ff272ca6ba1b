"""Rewrite an RGB-D image as if all its rows had been read at once, in the middle of its colour."""

from collections.abc import Callable
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
"""What is read at a pixel depends on where its point was then, and that on the row; so often is it looked up."""
SAME_SURFACE = 0.03
"""Readings of one surface differ by less than this share, as in alignment (native/align_pixel.h)."""
PIXEL_AND_NEXT = np.ones((2, 2), np.uint8)
Image = NDArray[Any]


def read_at_once(frame: Frame, readout: Readout) -> Frame:
    """Return the frame with colour [H, W, 3] and depth [H, W] as the camera sees them in the middle of its colour.

    Each pixel is looked up where its point was when its row was read; its motion is that of `readout.rate`, to second
    order. Pixels without depth move as those at the median depth.
    """
    cv2, c = opencv(), frame.camera
    z, everywhere_m = _depth_before(c, frame.depth_m, readout.rate, lambda row: readout.depth_s(row, c.height))
    row = _own_rows(c)
    for _ in range(ROUNDS):
        at = _seen_at(c, everywhere_m, readout.rate, readout.color_s(row, c.height))
        row = at[1]
    color = cv2.remap(frame.color, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0.0, 1.0)
    return replace(frame, color=color, depth_m=z)


def depth_of_color(camera: Camera, depth_m: Image, readout: Readout) -> Image:
    """Return the depth [H, W] of what each pixel shows in colour, when its colour is read; 0 where none is read. Beyond
    the depth image it is that of its border."""
    color_s = readout.color_s(_own_rows(camera), camera.height)
    return _depth_before(
        camera, depth_m, readout.rate, lambda row: readout.depth_s(row, camera.height) - color_s, True
    )[0]


def _own_rows(camera: Camera) -> Image:
    return np.arange(camera.height, dtype=np.float32)[:, None]


def _depth_before(
    camera: Camera, depth_m: Image, rate: Matrix, late_s: Callable[[Image], Image], beyond: bool = False
) -> tuple[Image, Image]:
    """Return the depth [H, W] that the camera saw some time before its readings, of which late_s gives that of some
    rows; and the same with the median depth where there is none. beyond: its border goes on outside."""
    z, row = depth_m, _own_rows(camera)
    usual_m = np.float32(np.median(depth_m[depth_m > 0]) if (depth_m > 0).any() else 1.0)
    for _ in range(ROUNDS):
        since_s = late_s(row)
        at = _seen_at(camera, np.where(z > 0, z, usual_m), rate, since_s)
        at = (at[0].clip(0, camera.width - 1), at[1].clip(0, camera.height - 1)) if beyond else at
        row, read_m = at[1], _between_readings(depth_m, *at)
        z = np.where(read_m > 0, _moved(_points(camera, *at, read_m), rate, -since_s)[2], np.float32(0.0))
    return np.maximum(z, np.float32(0.0)), np.where(z > 0, z, usual_m)


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
    """Return points in the camera after it has moved for late_s [H, 1 or W], to second order."""
    (x, y, z), (a, b, c, u, v, w), half_s = point, rate.astype(np.float32), np.float32(0.5) * late_s
    dx, dy, dz = a + v * z - w * y, b + w * x - u * z, c + u * y - v * x
    dx, dy, dz = dx - half_s * (v * dz - w * dy), dy - half_s * (w * dx - u * dz), dz - half_s * (u * dy - v * dx)
    return x - late_s * dx, y - late_s * dy, z - late_s * dz


def _seen_at(camera: Camera, z: Image, rate: Matrix, late_s: Image) -> tuple[Image, Image]:
    """Return the column and row at which the camera sees the points of the pixels at depth z [H, W] after it has moved
    for late_s [H, 1 or W]."""
    rows_columns: Image = np.indices(z.shape, np.float32)
    x, y, ahead = _moved(_points(camera, rows_columns[1], rows_columns[0], z), rate, late_s)
    (fx, fy, cx, cy), ahead = _intrinsics(camera), np.maximum(ahead, np.float32(1e-3))
    return fx * x / ahead + cx, fy * y / ahead + cy
