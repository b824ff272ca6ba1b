"""Lay out the path, the truth and lost frames as coloured segments and points; choose the keyframes to show."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.drawing.plot import ACCENT, BLUE, DARK, GREEN
from sigmasplat.types import Matrix
from sigmasplat.viewer.snapshot import Path

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MOST_SEGMENTS = 5000
MOST_KEYFRAMES = 100
SUBMAP_COLOURS = (DARK.curves[ACCENT], DARK.curves[GREEN])
"""Neighbours differ."""
TRUTH_COLOUR = DARK.curves[BLUE]
LOST_COLOUR = (255, 60, 60)


class Segments(NamedTuple):
    """Line segments: points [S, 2, 3] m in the world, colors uint8 [S, 2, 3]."""

    points: Floats
    colors: Bytes


def path_segments(path: Path, row: int, most: int = MOST_SEGMENTS) -> Segments:
    """Return the path up to frame `row`, each submap in another colour than the one before, red where it was lost.

    Long paths are drawn with at most about `most` segments, evenly chosen.
    """
    count = min(row + 1, len(path))
    rows = evenly(count, most + 1)
    colors = np.array(SUBMAP_COLOURS, np.uint8)[path.submaps[rows] % len(SUBMAP_COLOURS)]
    colors[path.lost[rows]] = LOST_COLOUR
    return _joined(path.T_world_camera[rows, :3, 3], colors)


def true_segments(positions: Matrix, most: int = MOST_SEGMENTS) -> Segments:
    """Return the true path [M, 3], world."""
    rows = evenly(len(positions), most + 1)
    return _joined(positions[rows], np.tile(np.array(TRUTH_COLOUR, np.uint8), (len(rows), 1)))


def lost_points(path: Path, row: int, most: int = MOST_SEGMENTS) -> Floats:
    """Return where the frames up to `row` that were lost are believed to be [L, 3] m."""
    rows = np.flatnonzero(path.lost[: row + 1])
    return np.asarray(path.T_world_camera[rows[evenly(len(rows), most)], :3, 3], np.float32)


def shown_keyframes(path: Path, row: int, most: int = MOST_KEYFRAMES) -> tuple[int, ...]:
    """Return the rows of at most `most` keyframes up to frame `row`: every 2ᵏ-th and the last, so that those shown
    stay the same while more come."""
    rows = [keyframe for keyframe in path.keyframes if keyframe <= row]
    stride = 1
    while len(rows) / stride > most - 1:
        stride *= 2
    return tuple(sorted({*rows[::stride], *rows[-1:]}))


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Choose at most `most` of `count` rows, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))


def _joined(positions: Matrix, colors: Bytes) -> Segments:
    """Join neighbours [n, 3]; a segment has the colours of its ends."""
    pairs = [np.stack([values[:-1], values[1:]], 1) for values in (positions, colors)]
    return Segments(np.asarray(pairs[0], np.float32), np.asarray(pairs[1], np.uint8))
