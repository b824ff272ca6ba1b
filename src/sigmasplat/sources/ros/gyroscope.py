"""Read the gyroscope of a bag from sensor_msgs/Imu, in the axes of the colour camera.

The axes come from /tf_static between the frames that the messages name, or from the transforms of RealSense's SDK. The
clock is that of the headers, as for the images, or the recording time if the headers fit no image.
"""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.model import se3
from sigmasplat.model.gyroscope import Gyroscope, gyroscope_from_samples
from sigmasplat.sources.ros.bag import Bag, Topic
from sigmasplat.sources.ros.cameras import sdk_pose, sdk_stream
from sigmasplat.sources.ros.tf import lookup_transform
from sigmasplat.sources.ros.topics import ImageTopic
from sigmasplat.types import Matrix

IMU = "sensor_msgs/msg/Imu"


def read_bag_gyroscope(bag: Bag, color: ImageTopic, frame_times_s: NDArray[np.float64]) -> Gyroscope | None:
    """Return the gyroscope; None if no topic has angular velocities whose axes relative to the colour camera are known.

    frame_times_s [N]: times of the images. If several topics qualify, those of the device of the camera are preferred,
    then the one with the most messages. Raises SourceError if the bag is damaged.
    """
    device = color.name.strip("/").partition("/")[0]

    def preferred(topic: Topic) -> tuple[bool, int, str]:
        return topic.name.strip("/").partition("/")[0] != device, -topic.count, topic.name

    for topic in sorted(bag.topics_of_type(IMU), key=preferred):
        R_color_imu = _axes(bag, color, topic.name)
        if R_color_imu is None or not _measures_rotation(bag, topic.name):
            continue
        entries = bag.index(topic.name)[topic.name]
        velocities = [message.angular_velocity for message in bag.messages(topic.name)]
        rates = np.array([(v.x, v.y, v.z) for v in velocities], np.float64) @ R_color_imu.T
        for times_ns in ([e.stamp_ns for e in entries], [e.recorded_ns for e in entries]):
            found = gyroscope_from_samples(np.array(times_ns) / 1e9, rates)
            if found is not None and found.measured_any(frame_times_s):
                return found
    return None


def _measures_rotation(bag: Bag, name: str) -> bool:
    """Return whether messages have angular velocities: without them the first value of the covariance is −1."""
    return bool(bag.first_message(name).angular_velocity_covariance[0] != -1)


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
