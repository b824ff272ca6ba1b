"""Read ROS 2 messages back with rosbags, and their parts as arrays."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def decoded(data: bytes, msgtype: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST).deserialize_cdr(data, msgtype)


def read_bag(folder: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic, in order of time."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store, found = get_typestore(Stores.LATEST), defaultdict[str, list[Any]](list)
    with Reader(folder) as reader:
        for connection, time_ns, raw in reader.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            stamp = message.transforms[0].header.stamp if hasattr(message, "transforms") else message.header.stamp
            assert time_ns == stamp.sec * 10**9 + stamp.nanosec
            found[connection.topic].append(message)
    return found


def seconds(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def matrix(position: Any, rotation: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def links(message: Any) -> dict[tuple[str, str], Array]:
    """Return T_parent_child of a message of transforms."""
    return {
        (t.header.frame_id, t.child_frame_id): matrix(t.transform.translation, t.transform.rotation)
        for t in message.transforms
    }


def pose(message: Any) -> Array:
    """Return the pose of an odometry or of a pose with covariance."""
    return matrix(message.pose.pose.position, message.pose.pose.orientation)


def covariance(message: Any) -> Array:
    return np.asarray(message.pose.covariance, np.float64).reshape(6, 6)


def image(message: Any) -> np.ndarray:
    kind, channels = {"rgb8": (np.uint8, 3), "32FC1": (np.float32, 1)}[message.encoding]
    array = np.frombuffer(message.data.tobytes(), kind).reshape(message.height, message.width, channels)
    return array[..., 0] if channels == 1 else array
