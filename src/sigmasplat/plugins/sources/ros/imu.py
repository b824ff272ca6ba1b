"""Read the gyroscope and the accelerometer of a bag from sensor_msgs/Imu, in the axes of the colour camera.

The axes come from /tf_static between the frames that the messages name, or from the transforms of RealSense's SDK. The
clock is that of the headers, as for the images, or the recording time if the headers fit no image.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.accelerometer import Accelerometer, accelerometer_from_samples
from sigmasplat.data.gyroscope import Gyroscope, gyroscope_from_samples
from sigmasplat.plugins.sources.ros.bag import Bag, Topic
from sigmasplat.plugins.sources.ros.cameras import sdk_pose, sdk_stream
from sigmasplat.plugins.sources.ros.tf import lookup_transform
from sigmasplat.plugins.sources.ros.topics import ImageTopic
from sigmasplat.types import Matrix

IMU = "sensor_msgs/msg/Imu"
Values = NDArray[np.float64]


class Imu(NamedTuple):
    """What moves with the camera; None = not measured."""

    gyroscope: Gyroscope | None
    accelerometer: Accelerometer | None


def read_bag_imu(bag: Bag, color: ImageTopic, frame_times_s: Values) -> Imu:
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
        for times_s in _clocks(bag, topic.name):
            gyroscope = gyroscope or _gyroscope(times_s, rates, frame_times_s)
            accelerometer = accelerometer or _accelerometer(times_s, forces, frame_times_s)
        if gyroscope and accelerometer:
            break
    return Imu(gyroscope, accelerometer)


def _gyroscope(times_s: Values, rates: Values, frame_times_s: Values) -> Gyroscope | None:
    found = gyroscope_from_samples(times_s, rates)
    return found if found is not None and found.measured_any(frame_times_s) else None


def _accelerometer(times_s: Values, forces: Values, frame_times_s: Values) -> Accelerometer | None:
    found = accelerometer_from_samples(times_s, forces)
    return found if found is not None and any(found.at(t) is not None for t in frame_times_s) else None


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


def _clocks(bag: Bag, name: str) -> tuple[Values, Values]:
    """Return the times of the messages [M], s: of the headers, and of recording."""
    entries = bag.index(name)[name]
    return np.array([e.stamp_ns for e in entries]) / 1e9, np.array([e.recorded_ns for e in entries]) / 1e9


def _axes(bag: Bag, color: ImageTopic, name: str) -> Matrix | None:
    """Return R_color_imu [3, 3], None if it is not known."""
    stream = name.removesuffix("/imu/data")
    if name.startswith("/device_"):
        T_color_reference, T_imu_reference = sdk_pose(bag, sdk_stream(color)), sdk_pose(bag, stream)
        if T_color_reference is None or T_imu_reference is None:
            return None
        return (T_color_reference @ se3.inverse(T_imu_reference))[:3, :3]
    frame = bag.first_message(name).header.frame_id.lstrip("/")
    if not (frame and color.frame):
        return None
    if frame == color.frame:
        return np.eye(3)
    T = lookup_transform(bag, color.frame, frame, use_tf=False)
    return None if T is None else T[:3, :3]
