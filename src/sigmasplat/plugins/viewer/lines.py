"""Turn the path, the true path and the lost frames into coloured segments and points; choose the keyframes to show."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, DARK, GREEN
from sigmasplat.plugins.viewer.snapshot import CameraPath
from sigmasplat.types import Matrix

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MAX_SEGMENTS = 5000
MAX_KEYFRAMES = 100
SUBMAP_COLOURS = (DARK.curves[ACCENT], DARK.curves[GREEN])
"""Used alternately, so that neighbouring submaps differ."""
TRUTH_COLOUR = DARK.curves[BLUE]
LOST_COLOUR = (255, 60, 60)


class Segments(NamedTuple):
    """Line segments: points [S, 2, 3] m in the world, colors uint8 [S, 2, 3]."""

    points: Floats
    colors: Bytes


def path_segments(path: CameraPath, row: int, most: int = MAX_SEGMENTS) -> Segments:
    """Return the path up to frame `row`, in alternating colours per submap, red at lost frames.

    A long path is reduced to about `most` evenly spaced segments. Frames outside the world are left out.
    """
    count = min(row + 1, len(path))
    rows = evenly_spaced(count, most + 1)
    colors = np.array(SUBMAP_COLOURS, np.uint8)[path.submaps[rows] % len(SUBMAP_COLOURS)]
    colors[path.lost[rows]] = LOST_COLOUR
    segments, inside = _segments(path.T_world_camera[rows, :3, 3], colors), path.inside[rows]
    drawn = inside[:-1] & inside[1:]
    return Segments(segments.points[drawn], segments.colors[drawn])


def truth_segments(positions: Matrix, most: int = MAX_SEGMENTS) -> Segments:
    """Return segments of the true path [M, 3] m in the world, at most about `most`."""
    rows = evenly_spaced(len(positions), most + 1)
    return _segments(positions[rows], np.tile(np.array(TRUTH_COLOUR, np.uint8), (len(rows), 1)))


def lost_points(path: CameraPath, row: int, most: int = MAX_SEGMENTS) -> Floats:
    """Return the estimated positions [L, 3] m of the lost frames up to `row`, at most `most`."""
    rows = np.flatnonzero((path.lost & path.inside)[: row + 1])
    return np.asarray(path.T_world_camera[rows[evenly_spaced(len(rows), most)], :3, 3], np.float32)


def keyframes_to_show(path: CameraPath, row: int, most: int = MAX_KEYFRAMES) -> tuple[int, ...]:
    """Return the rows of at most `most` keyframes up to frame `row`: every 2ᵏ-th one and the last.

    With a power of two most of the keyframes shown stay the same while new ones are added.
    """
    inside = path.inside
    rows = [keyframe for keyframe in path.keyframes if keyframe <= row and inside[keyframe]]
    stride = 1
    while len(rows) / stride > most - 1:
        stride *= 2
    return tuple(sorted({*rows[::stride], *rows[-1:]}))


def evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` evenly spaced rows of `count`, including the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))


def _segments(positions: Matrix, colors: Bytes) -> Segments:
    """Return the segments between neighbouring positions [n, 3]; a segment has the colours of its ends."""
    pairs = [np.stack([values[:-1], values[1:]], 1) for values in (positions, colors)]
    return Segments(np.asarray(pairs[0], np.float32), np.asarray(pairs[1], np.uint8))
