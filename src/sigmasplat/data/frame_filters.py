"""Change frames before SLAM sees them: masks and depth filters of plug-ins, by their names."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sigmasplat.data.frame import Frame
from sigmasplat.errors import ConfigError
from sigmasplat.registry import DepthFilter, Mask, named

FrameFilter = Callable[[Frame], Frame]


def frame_filter(names: str) -> FrameFilter:
    """Return the function that applies masks and depth filters in the order of their names, separated by commas.

    Raises ConfigError if a name is unknown; the function raises it if a plug-in returns another shape or type.
    """
    chosen = [named((Mask, DepthFilter), name.strip()) for name in names.split(",") if name.strip()]

    def apply(frame: Frame) -> Frame:
        for row in chosen:
            frame = _masked(frame, row) if isinstance(row, Mask) else _filtered(frame, row)
        return frame

    return apply


def _masked(frame: Frame, mask: Mask) -> Frame:
    ignored, size = np.asarray(mask.ignored(frame)), frame.depth_m.shape
    if ignored.dtype != np.bool_ or ignored.shape != size:
        raise ConfigError(f"mask {mask.name!r} returned {ignored.dtype} {ignored.shape}; return bool {size}")
    known = ignored if frame.ignored is None else frame.ignored | ignored
    return replace(frame, depth_m=np.where(ignored, np.float32(0.0), frame.depth_m), ignored=known)


def _filtered(frame: Frame, row: DepthFilter) -> Frame:
    """Return the frame with the filter's depth; a reading where there was none is as sure as the median reading."""
    depth_m, size = np.asarray(row.filtered(frame), np.float32), frame.depth_m.shape
    if depth_m.shape != size:
        raise ConfigError(f"depth filter {row.name!r} returned {depth_m.shape}; return {size}")
    std_m = frame.depth_std_m
    if std_m is not None:
        std_m = np.where(std_m > 0, std_m, np.median(std_m[frame.depth_m > 0]) if (frame.depth_m > 0).any() else 1.0)
    return replace(frame, depth_m=depth_m, depth_std_m=None if std_m is None else std_m.astype(np.float32))
