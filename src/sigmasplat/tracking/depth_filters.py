"""Change the depth of a frame before SLAM sees it: our filter of noise, and masks and depth filters of plug-ins.

`prepared_frame.working_frame` calls `denoised`; `slam.slam_state` and `run.localise` call `frame_filter`. A filter of
your own is a row in a file of its own (docs/recipes.md, "A plug-in of your own").
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.frame import Frame
from sigmasplat.env import opencv
from sigmasplat.errors import ConfigError
from sigmasplat.fit.compare import noise_scale
from sigmasplat.fit.pyramid import NOISE_PER_M
from sigmasplat.registry import WORDS, DepthFilter, Mask, named

DIAMETER_PX = 5
"""Each reading becomes the weighted mean of the readings in a window of this width."""
SPREAD_PX, SPREAD_SIGMA = 2.0, 3.0
"""Spread of the weights: with the distance in pixels, and with the difference of the readings in standard deviations of
a reading, so that depth steps stay sharp."""
HOLE = -1.0
"""Inverse depth, 1/m, of a pixel without a reading: so far from all readings that its weight is 0."""


def denoised(
    depth_m: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0
) -> NDArray[np.float32]:
    """Return depth [H, W] m, 0 = no reading, smoothed by a bilateral filter if its noise is above that of the sensor
    model (`noise_scale`); otherwise the same image. Holes stay holes.

    The filter works on inverse depth (Tomasi & Manduchi 1998): noise that grows with z² is constant there.
    """
    scale = noise_scale(depth_m, noise_per_m, scene_scale)
    if scale <= 1.0:
        return depth_m
    read = depth_m > 0
    inverse = np.where(read, 1.0 / np.maximum(depth_m, np.float32(1e-3)), np.float32(HOLE)).astype(np.float32)
    smooth = opencv().bilateralFilter(inverse, DIAMETER_PX, SPREAD_SIGMA * scale * noise_per_m, SPREAD_PX)
    return np.where(read, 1.0 / np.maximum(smooth, np.float32(1e-3)), np.float32(0.0)).astype(np.float32)


FrameFilter = Callable[[Frame], Frame]


def frame_filter(names: str) -> FrameFilter:
    """Return the function that applies masks and depth filters in the order of their names, separated by commas.

    Raises ConfigError if a name is unknown; the function raises it if a plug-in returns no such image.
    """
    chosen = [named((Mask, DepthFilter), name.strip()) for name in names.split(",") if name.strip()]

    def apply(frame: Frame) -> Frame:
        for row in chosen:
            frame = _masked(frame, row) if isinstance(row, Mask) else _filtered(frame, row)
        return frame

    return apply


def _masked(frame: Frame, mask: Mask) -> Frame:
    ignored = _image_of(mask, mask.ignored(frame), "b", "bool", frame)
    known = ignored if frame.ignored is None else frame.ignored | ignored
    return replace(frame, depth_m=np.where(ignored, np.float32(0.0), frame.depth_m), ignored=known)


def _filtered(frame: Frame, row: DepthFilter) -> Frame:
    depth_m = _image_of(row, row.filtered(frame), "fiu", "float32", frame).astype(np.float32)
    if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
        raise ConfigError(f"depth filter {row.name!r} returned NaN, infinite or negative depth; 0 = no reading")
    return replace(frame, depth_m=depth_m)


def _image_of(row: Mask | DepthFilter, returned: object, kinds: str, wanted: str, frame: Frame) -> NDArray[Any]:
    """Return what a plug-in returned. Raises ConfigError unless it has the frame's size and one of the numpy kinds."""
    image, size = np.asarray(returned), frame.depth_m.shape
    if image.dtype.kind not in kinds or image.shape != size:
        found = "None" if returned is None else f"{image.dtype} {image.shape}"
        raise ConfigError(f"{WORDS[type(row)]} {row.name!r} returned {found}; return {wanted} {size}")
    return image
