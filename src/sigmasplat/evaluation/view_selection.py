"""Choose which views to score, and prepare their frames as SLAM did."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.model.frame import Frame
from sigmasplat.sources.base import Source

Item = TypeVar("Item")


def evenly_spread(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` items, evenly spread, with the first and the last one."""
    rows = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))
    return [items[row] for row in rows]


def working_frame(source: Source, settings: InputConfig, index: int) -> Frame:
    """Read a frame at the resolution, depth range and crop that SLAM works with. Raises SourceError if unreadable."""
    s = settings
    return source.frame(index).prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
