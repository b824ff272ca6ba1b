"""Read ROS 1 bags, ROS 2 bags, MCAP files, and recordings of RealSense's SDK.

Topics are found by their content, or chosen with input.color_topic and input.depth_topic. Opening reads the bag once
for the timestamps; images are read on demand.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.input.association import MAX_GAP_S, associate, no_pairs, refuse_other_units
from sigmasplat.input.recorded import ImagePair, RecordedSource, Size
from sigmasplat.plugins.sources.ros.bag import Bag, Entry, is_bag
from sigmasplat.plugins.sources.ros.cameras import read_bag_calibration
from sigmasplat.plugins.sources.ros.images import decode_color_message, decode_depth_message, message_size
from sigmasplat.plugins.sources.ros.imu import read_bag_imu
from sigmasplat.plugins.sources.ros.topics import color_topic, depth_topic
from sigmasplat.plugins.sources.ros.truth import read_truth
from sigmasplat.plugins.sources.stereo_bag import open_stereo_bag, stereo_topics
from sigmasplat.registry import SourceFormat

Times = NDArray[np.float64]


@dataclass(frozen=True)
class BagImagePair(ImagePair):
    """A pair of messages; the paths contain bag, topic and time."""

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
    """Open a bag. Raises SourceError if it is damaged, its topics are ambiguous, or its cameras are unknown."""
    bag = Bag(path)
    if pair := stereo_topics(bag, settings):
        return open_stereo_bag(bag, *pair, settings)
    color, depth = color_topic(bag, settings.color_topic), depth_topic(bag, settings.depth_topic)
    calibration = read_bag_calibration(bag, color, depth, settings)
    found = bag.index(color.name, depth.name)
    entries = found[color.name], found[depth.name]
    pairs, recorded_time = _paired(entries)
    named = {name: _times_s(found[name], recorded_time) for name in (color.name, depth.name)}
    refuse_other_units(path, named)
    if not len(pairs):
        raise no_pairs(path, {name: _times_s(found[name], True) for name in (color.name, depth.name)})
    truth = read_truth(bag, color.frame, recorded_time)
    topics = (color.name, depth.name)
    color_s, depth_s = (_times_s(part, recorded_time) for part in entries)
    colors = [_message_path(path, color.name, t) for t in color_s]
    depths = [_message_path(path, depth.name, t) for t in depth_s]
    images = [
        BagImagePair(float(color_s[i]), colors[i], depths[j], bag, topics, (entries[0][i], entries[1][j]))
        for i, j in pairs
    ]
    imu = read_bag_imu(bag, color, color_s)
    alone = sorted(set(range(len(entries[0]))) - set(pairs[:, 0].tolist()))
    skipped = [f"{colors[i]}: no depth within {MAX_GAP_S:g} s" for i in alone]
    name = path.resolve().stem
    return RecordedSource(name, images, calibration, settings, truth, skipped, **imu._asdict())


def _paired(entries: tuple[Sequence[Entry], Sequence[Entry]]) -> tuple[NDArray[np.intp], bool]:
    """Pair colour with depth by header time, or by recording time if that finds more pairs.

    Some drivers leave the headers empty, or use a different clock for each sensor.
    """
    clocks = (False, True) if _headers_have_times(entries) else (True,)
    found = []
    for recorded in clocks:
        color_s, depth_s = (_times_s(part, recorded) for part in entries)
        found.append((associate(color_s, depth_s), recorded))
    return max(found, key=lambda answer: len(answer[0]))


def _headers_have_times(entries: tuple[Sequence[Entry], Sequence[Entry]]) -> bool:
    """Return whether the headers contain times."""
    return all(part[0].stamp_ns != part[-1].stamp_ns or len(part) == 1 for part in entries)


def _times_s(entries: Sequence[Entry], recorded: bool) -> Times:
    return np.array([(e.recorded_ns if recorded else e.stamp_ns) / 1e9 for e in entries])


def _message_path(path: Path, topic: str, time_s: float) -> Path:
    return path / f"{topic.lstrip('/')} at {time_s:.3f} s"


PLUGIN = SourceFormat(
    "ROS bag",
    "a .bag, .mcap or .db3 file, or a folder with metadata.yaml",
    lambda path: is_bag(Path(path)),
    lambda path, settings: open_bag(Path(path), settings),
)
