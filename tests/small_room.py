"""The beginning of a walk round the synthetic room, in small frames, for runs of the whole of SLAM."""

from functools import cache

from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import SyntheticRoom

SMALL = {"input.width": "160", "mapping.first_iterations": "60", "mapping.iterations": "20"}
"""Settings that make runs on these frames short."""


@cache
def walk() -> SyntheticRoom:
    """Return two hundred frames once round the room; tests take its beginning."""
    return SyntheticRoom(frames=200, width=160, height=120)


@cache
def frame_at(i: int) -> Frame:
    return walk().frame(i)


def frames(count: int) -> list[Frame]:
    """Return the first frames of the walk."""
    return [frame_at(i) for i in range(count)]
