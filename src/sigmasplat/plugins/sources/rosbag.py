"""Read ROS 1 bags, ROS 2 bags, MCAP files, and recordings of RealSense's SDK.

Topics are found by their content, or chosen with input.color_topic and input.depth_topic. Opening reads the bag once
for the timestamps; images are read on demand.

Gyroscope and accelerometer come from sensor_msgs/Imu, in the axes of the colour camera: from /tf_static between the
frames that the messages name, or from the transforms of RealSense's SDK. The clock is that of the headers, as for the
images, or the recording time if the headers fit no image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import InputConfig, RecordedSource, Size
from sigmasplat.plugins.sources import bag_cameras, bag_messages
from sigmasplat.plugins.sources.bag_cameras import ImageTopic
from sigmasplat.plugins.sources.bag_messages import Bag, Entry, Message, Topic, is_bag, message_size

IMU = "sensor_msgs/msg/Imu"
Values = NDArray[np.float64]


def read_bag_imu(
    bag: Bag, color: ImageTopic, frame_times_s: Values
) -> tuple[api.Gyroscope | None, api.Accelerometer | None]:
    """Return gyroscope and accelerometer, each of the first topic that has its values in axes whose rotation to the
    colour camera is known. Cameras may publish them in two topics.

    frame_times_s [N]: times of the images. Topics of the device of the camera come first, then those with the most
    messages. Raises SourceError if the bag is damaged.
    """
    device = color.name.strip("/").partition("/")[0]

    def preferred(topic: Topic) -> tuple[bool, int, str]:
        return topic.name.strip("/").partition("/")[0] != device, -topic.count, topic.name

    gyroscope, accelerometer = None, None
    for topic in sorted(bag.topics_of_type(IMU), key=preferred):
        R_color_imu = _axes(bag, color, topic.name)
        if R_color_imu is None:
            continue
        rates, forces = (values @ R_color_imu.T for values in _measured(bag, topic.name))
        entries = bag.index(topic.name)[topic.name]
        for times_s in (_times_s(entries, recorded) for recorded in (False, True)):
            turns, pulls = api.gyroscope_from_samples(times_s, rates), api.accelerometer_from_samples(times_s, forces)
            if gyroscope is None and turns and turns.measured_any(frame_times_s):
                gyroscope = turns
            if accelerometer is None and pulls and any(pulls.at(t) is not None for t in frame_times_s):
                accelerometer = pulls
        if gyroscope and accelerometer:
            break
    return gyroscope, accelerometer


def _measured(bag: Bag, name: str) -> tuple[Values, Values]:
    """Return angular velocities and specific forces [M, 3]; nan without them: the first value of the covariance is −1
    then."""
    # Numbers only: the messages of an hour would take a gigabyte.
    rows = [
        [(v.x, v.y, v.z, covariance[0]) for v, covariance in (
            (message.angular_velocity, message.angular_velocity_covariance),
            (message.linear_acceleration, message.linear_acceleration_covariance),
        )]
        for message in bag.messages(name)
    ]  # fmt: skip
    values = np.array(rows, np.float64).reshape(-1, 2, 4)
    rates, forces = np.where(values[..., 3:] == -1, np.nan, values[..., :3]).swapaxes(0, 1)
    return rates, forces


def _axes(bag: Bag, color: ImageTopic, name: str) -> api.Matrix | None:
    if name.startswith("/device_"):
        T = bag_cameras.sdk_transform(bag, color, name.removesuffix("/imu/data"))
        return None if T is None else T[:3, :3]
    frame = bag.first_message(name).header.frame_id.lstrip("/")
    if not (frame and color.frame):
        return None
    if frame == color.frame:
        return np.eye(3)
    T = bag_cameras.lookup_transform(bag, color.frame, frame, use_tf=False)
    return None if T is None else T[:3, :3]


@dataclass(frozen=True)
class BagImagePair(api.ImagePair):
    """Two messages of a bag; the paths contain bag, topic and time."""

    bag: Bag
    topics: tuple[str, str]
    entries: tuple[Entry, Entry]

    def read_color(self) -> NDArray[Any]:
        return bag_messages.decode_color_message(self.color, self._message(0))

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        return bag_messages.decode_depth_message(self.depth, self._message(1), units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        return message_size(self.color, self._message(0)), message_size(self.depth, self._message(1))

    def _message(self, which: int) -> Message:
        return self.bag.read(self.topics[which], self.entries[which])


def open_bag(place: str, settings: InputConfig) -> RecordedSource:
    """Open a bag. Raises SourceError if it is damaged, its topics are ambiguous, or its cameras are unknown."""
    bag = Bag(Path(place))
    color = bag_cameras.color_topic(bag, settings.color_topic)
    depth = bag_cameras.depth_topic(bag, settings.depth_topic, color)
    calibration, topics = bag_cameras.read_bag_calibration(bag, color, depth, settings), (color.name, depth.name)
    found = bag.index(*topics)
    entries = found[color.name], found[depth.name]
    recorded_time = _uses_recorded_time(entries, settings)
    color_s, depth_s = (_times_s(part, recorded_time) for part in entries)
    colors, depths = _message_paths(bag, color.name, color_s), _message_paths(bag, depth.name, depth_s)
    depth_s = depth_s - settings.depth_delay_s
    pairs, alone = api.pair_times(bag.path, {color.name: color_s, depth.name: depth_s}, settings)
    known = 0.0 if recorded_time else 1.0  # how long messages travel says nothing about the images
    times = [(i, j, float(color_s[i]), known * float(depth_s[j] - color_s[i])) for i, j in pairs]
    images = [
        BagImagePair(t, colors[i], depths[j], bag, topics, (entries[0][i], entries[1][j]), depth_late_s=late)
        for i, j, t, late in times
    ]
    skipped = [f"{colors[i]}: no depth within {settings.max_gap_s:g} s" for i in alone]
    clock = ("recording time", api.ASSUMED, "header times") if recorded_time else ("header time", "read from the bag")
    gyroscope, accelerometer = read_bag_imu(bag, color, color_s)
    return RecordedSource(
        bag.path.resolve().stem, images, calibration, settings, None, skipped, None, gyroscope, accelerometer,
        origins=api.time_origins(settings, f"by {clock[0]}", *clock[1:]),
    )  # fmt: skip


def _uses_recorded_time(entries: tuple[Sequence[Entry], Sequence[Entry]], settings: InputConfig) -> bool:
    """Return whether the recording times pair colour with depth more often than the header times.

    Some drivers leave the headers empty, or use a different clock for each sensor.
    """
    has_times = all(part[0].stamp_ns != part[-1].stamp_ns or len(part) == 1 for part in entries)

    def pairs(recorded: bool) -> int:
        color_s, depth_s = (_times_s(part, recorded) for part in entries)
        return len(api.associate(color_s, depth_s - settings.depth_delay_s, settings.max_gap_s))

    return not has_times or pairs(True) > pairs(False)


def _times_s(entries: Sequence[Entry], recorded: bool) -> Values:
    return np.array([(e.recorded_ns if recorded else e.stamp_ns) / 1e9 for e in entries])


def _message_paths(bag: Bag, topic: str, times_s: Values) -> list[Path]:
    return [bag.path / f"{topic.lstrip('/')} at {time_s:.3f} s" for time_s in times_s]


PLUGIN = api.SourceFormat(
    "ROS bag", "a .bag, .mcap or .db3 file, or a folder with metadata.yaml", lambda path: is_bag(Path(path)), open_bag
)
