"""Prepare the frames of scored views as SLAM did."""

from sigmasplat.config import InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.input.source import Source


def working_frame(source: Source, settings: InputConfig, index: int) -> Frame:
    """Read a frame at the resolution, depth range and crop that SLAM works with. Raises SourceError if unreadable."""
    s = settings
    return source.frame(index).prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
