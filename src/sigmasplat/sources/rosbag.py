"""Read RGB-D recordings of robots: ROS 1 bags, ROS 2 bags, MCAP files, and what RealSense's SDK records.

Topics are found by what they hold, or chosen with input.color_topic and input.depth_topic. The bag is gone through once
for the times; images are read when they are asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.sources.files.association import associate
from sigmasplat.sources.opening import Format
from sigmasplat.sources.recorded import ImagePair, RecordedSource, Size
from sigmasplat.sources.ros.bag import Bag, Entry, is_bag
from sigmasplat.sources.ros.cameras import read_bag_calibration
from sigmasplat.sources.ros.images import decode_color_message, decode_depth_message, message_size
from sigmasplat.sources.ros.topics import color_topic, depth_topic
from sigmasplat.sources.ros.truth import read_truth

MAX_GAP_S = 0.02
"""Colour and depth of one camera at 30 Hz are never further apart."""
Times = NDArray[np.float64]


@dataclass(frozen=True)
class BagImagePair(ImagePair):
    """A pair of messages; the paths name topic and time below the bag."""

    bag: Bag
    topics: tuple[str, str]
    entries: tuple[Entry, Entry]

    def read_color(self) -> NDArray[np.uint8]:
        """Read 8-bit RGB [H, W, 3]. Raises SourceError naming topic and time."""
        return decode_color_message(self.color, self.bag.read(self.topics[0], self.entries[0]))

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Read depth in metres [H, W]. Raises SourceError naming topic and time."""
        return decode_depth_message(self.depth, self.bag.read(self.topics[1], self.entries[1]), units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of colour and depth. Raises SourceError naming topic and time."""
        paths = (self.color, self.depth)
        color, depth = (
            message_size(p, self.bag.read(t, e)) for p, t, e in zip(paths, self.topics, self.entries, strict=True)
        )
        return color, depth


def open_bag(path: Path, settings: InputConfig) -> RecordedSource:
    """Open a bag; raises SourceError if it is damaged, its topics are not clear, or its cameras are not known."""
    bag = Bag(path)
    color, depth = color_topic(bag, settings.color_topic), depth_topic(bag, settings.depth_topic)
    calibration = read_bag_calibration(bag, color, depth, settings)
    found = bag.index(color.name, depth.name)
    entries = found[color.name], found[depth.name]
    pairs, recorded_time = _paired(entries)
    if not len(pairs):
        raise SourceError(_no_overlap(path, (color.name, depth.name), entries))
    truth = read_truth(bag, color.frame, recorded_time)
    topics = (color.name, depth.name)
    color_s, depth_s = (_times_s(part, recorded_time) for part in entries)
    colors = [_message_path(path, color.name, t) for t in color_s]
    depths = [_message_path(path, depth.name, t) for t in depth_s]
    images = [
        BagImagePair(float(color_s[i]), colors[i], depths[j], bag, topics, (entries[0][i], entries[1][j]))
        for i, j in pairs
    ]
    alone = sorted(set(range(len(entries[0]))) - set(pairs[:, 0].tolist()))
    skipped = [f"{colors[i]}: no depth within {MAX_GAP_S:g} s" for i in alone]
    return RecordedSource(path.resolve().stem, images, calibration, settings, truth, skipped)


def _paired(entries: tuple[Sequence[Entry], Sequence[Entry]]) -> tuple[NDArray[np.intp], bool]:
    """Pair colour with depth by the headers' times, or by those of recording where that finds more.

    Some drivers leave headers empty, or take the times of two sensors from two clocks.
    """
    clocks = (False, True) if _headers_have_times(entries) else (True,)
    found = []
    for recorded in clocks:
        color_s, depth_s = (_times_s(part, recorded) for part in entries)
        found.append((associate(color_s, depth_s, MAX_GAP_S), recorded))
    return max(found, key=lambda answer: len(answer[0]))


def _headers_have_times(entries: tuple[Sequence[Entry], Sequence[Entry]]) -> bool:
    """Tell whether the headers hold times at all."""
    return all(part[0].stamp_ns != part[-1].stamp_ns or len(part) == 1 for part in entries)


def _times_s(entries: Sequence[Entry], recorded: bool) -> Times:
    return np.array([(e.recorded_ns if recorded else e.stamp_ns) / 1e9 for e in entries])


def _message_path(path: Path, topic: str, time_s: float) -> Path:
    return path / f"{topic.lstrip('/')} at {time_s:.3f} s"


def _no_overlap(path: Path, topics: tuple[str, str], entries: tuple[Sequence[Entry], Sequence[Entry]]) -> str:
    times = partial(_times_s, recorded=True)
    spans = [f"{n} {times(e).min():.3f} … {times(e).max():.3f} s" for n, e in zip(topics, entries, strict=True)]
    return f"no colour image of {path} has depth within {MAX_GAP_S:g} s ({', '.join(spans)}); one recording?"


FORMAT = Format(
    "ROS bag",
    "a .bag, .mcap or .db3 file, or a folder with metadata.yaml",
    lambda path: is_bag(Path(path)),
    lambda path, settings: open_bag(Path(path), settings),
)
