"""Rewrite an RGB-D image as if all its rows had been read at once, in the middle of its colour."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import Readout
from sigmasplat.env import opencv
from sigmasplat.native import _core

ROUNDS = 2
"""What is read at a pixel depends on where its point was then, and that on the row; so often is it looked up."""
SAME_SURFACE = 0.03
"""Readings of one surface differ by less than this share, as in alignment (native/align_pixel.h)."""
Image = NDArray[Any]


def read_at_once(frame: Frame, readout: Readout) -> Frame:
    """Return the frame with colour [H, W, 3] and depth [H, W] as the camera sees them in the middle of its colour.

    Each pixel is looked up where its point was when its row was read; its motion is that of `readout.rate`, to second
    order. Pixels without depth move as those at the median depth.
    """
    cv2, color_at = opencv(), np.empty((2, *frame.depth_m.shape), np.float32)
    color, depth_m = frame.color, depth_of_color(frame.camera, frame.depth_m, readout, color_at)
    if readout.times.color_rows_s:
        color = cv2.remap(color, *color_at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0.0, 1.0)
    return replace(frame, color=color, depth_m=depth_m)


def depth_of_color(camera: Camera, depth_m: Image, readout: Readout, color_at: Image | None = None) -> Image:
    """Return the depth [H, W] of what each pixel shows in colour, when its colour is read; 0 where none is read. Beyond
    the depth image it is that of its border. With color_at [2, H, W]: the depth that the camera saw in the middle of
    colour; the column and row at which colour shows it are written there."""
    c, before_m, some_m = camera, np.empty(depth_m.shape, np.float32), depth_m[::4, ::4]
    usual_m = float(np.median(some_m[some_m > 0])) if (some_m > 0).any() else 1.0
    _core.read_before(
        np.ascontiguousarray(depth_m, np.float32), [c.fx, c.fy, c.cx, c.cy], readout.numbers, ROUNDS, SAME_SURFACE,
        usual_m, before_m, color_at,
    )  # fmt: skip
    return before_m
