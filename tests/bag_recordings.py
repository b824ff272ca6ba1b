"""Write small bags of ROS 1 and ROS 2, as robots record them."""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recordings import Scene, encoded, xyzw

FOCAL = (40.0, 41.0, 15.0, 12.0)
CAMERA_TOPICS = ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")


@dataclass
class Recorder:
    """Collects messages, then writes a bag: ROS 1, ROS 2 with SQLite, or ROS 2 with MCAP."""

    ros1: bool = False
    messages: list[tuple[str, str, int, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            fields = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(fields, "tf2_msgs/msg/TFMessage"))

    def make(self, kind: str, **fields: Any) -> Any:
        """Create a message; missing fields are zero or empty."""
        return self.store.types[kind](**fields)

    def header(self, time_s: float, frame: str) -> Any:
        nanoseconds = round(time_s * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def add(self, topic: str, time_s: float, message: Any) -> None:
        self.messages.append((topic, message.__msgtype__, round(time_s * 1e9), message))

    def image(self, topic: str, time_s: float, array: np.ndarray, encoding: str, frame: str, late_s: float = 0.0,
              pad: int = 0, big: bool = False) -> None:  # fmt: skip
        """Add an image, recorded `late_s` after its header's time, with padded rows or big-endian numbers."""
        height, width = array.shape[:2]
        rows = np.ascontiguousarray(array.byteswap() if big else array).reshape(height, -1).view(np.uint8)
        data = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
        message = self.make(
            "sensor_msgs/msg/Image", header=self.header(time_s, frame), height=height, width=width, encoding=encoding,
            is_bigendian=int(big), step=data.shape[1], data=data.reshape(-1),
        )  # fmt: skip
        self.add(topic, time_s + late_s, message)

    def compressed(self, topic: str, time_s: float, data: bytes, kind: str, frame: str) -> None:
        message = self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(time_s, frame), format=kind,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip
        self.add(topic, time_s, message)

    def info(self, topic: str, time_s: float, size: tuple[int, int], focal: tuple[float, ...], frame: str,
             lens: tuple[float, ...] = (0.0,) * 5, model: str = "plumb_bob") -> None:  # fmt: skip
        fx, fy, cx, cy = focal
        values = {"d": np.array(lens), "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), "r": np.eye(3).reshape(-1),
                  "p": np.array([fx + 1, 0, cx, 0, 0, fy + 1, cy, 0, 0, 0, 1.0, 0])}  # fmt: skip
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(time_s, frame), height=size[1], width=size[0],
            distortion_model=model, binning_x=0, binning_y=0, roi=roi,
            **{(key.upper() if self.ros1 else key): value for key, value in values.items()},
        )  # fmt: skip
        self.add(topic, time_s, message)

    def moved(self, T: np.ndarray) -> Any:
        """Create a geometry_msgs/Transform."""
        x, y, z, w = xyzw(T)
        return self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, T[:3, 3]), strict=True))),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w)),
        )

    def transform(self, topic: str, time_s: float, parent: str, child: str, T: np.ndarray) -> Any:
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(time_s, parent), child_frame_id=child,
            transform=self.moved(T),
        )  # fmt: skip
        self.add(topic, time_s, self.make("tf2_msgs/msg/TFMessage", transforms=[stamped]))
        return stamped

    def pose(self, time_s: float, T: np.ndarray) -> Any:
        """Create a PoseStamped."""
        x, y, z, w = xyzw(T)
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, T[:3, 3]), strict=True))),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w)),
        )
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(time_s, "world"), pose=pose)

    def imu(
        self, topic: str, time_s: float, rates: np.ndarray, frame: str, late_s: float = 0.0, unknown: bool = False,
        force: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Add a sensor_msgs/Imu; unknown: it has no angular velocity; force: specific force, m/s², None = without."""
        vectors = [self.make("geometry_msgs/msg/Vector3", x=float(v[0]), y=float(v[1]), z=float(v[2]))
                   for v in (rates, np.zeros(3) if force is None else force)]  # fmt: skip
        known, none = np.zeros(9), np.array([-1.0, *np.zeros(8)])
        message = self.make(
            "sensor_msgs/msg/Imu", header=self.header(time_s, frame),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=none, angular_velocity=vectors[0],
            angular_velocity_covariance=none if unknown else known, linear_acceleration=vectors[1],
            linear_acceleration_covariance=none if force is None else known,
        )  # fmt: skip
        self.add(topic, time_s + late_s, message)

    def write(self, path: Path, storage: str = "sqlite3") -> Path:
        """Write a .bag, or a ROS 2 folder; return the path."""
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin, Writer as Writer2

        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        with Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for topic, kind, time_ns, message in self.messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                serialise = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
                writer.write(connections[topic], time_ns, serialise(message, kind))
        return path


def compressed_depth(depth_mm: np.ndarray) -> bytes:
    """Encode 16UC1 as compressed_depth_image_transport does: 12 unused bytes, then a PNG."""
    return struct.pack("<iff", 0, 100.0, 10.0) + encoded(depth_mm, "PNG")


def quantised_depth(depth_m: np.ndarray, a: float = 10_000.0, b: float = -90.0) -> bytes:
    """Encode 32FC1 as compressed_depth_image_transport does: the PNG holds a / depth + b."""
    with np.errstate(divide="ignore"):
        levels = np.where(depth_m > 0, a / depth_m + b, 0.0)
    return struct.pack("<iff", 0, a, b) + encoded(np.rint(levels).astype(np.uint16), "PNG")


def aligned(recorder: Recorder, seen: Scene) -> Recorder:
    """Add the topics of a RealSense with aligned depth: colour 4 ms before depth, recorded after the header times."""
    size = seen.colors.shape[2], seen.colors.shape[1]
    for color, depth, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
        recorder.image(CAMERA_TOPICS[0], t, color, "rgb8", "camera_color_optical_frame", late_s=0.05)
        recorder.image(CAMERA_TOPICS[1], t + 0.004, depth, "16UC1", "camera_color_optical_frame", late_s=0.012)
    recorder.info("/camera/color/camera_info", seen.times_s[0], size, FOCAL, "camera_color_optical_frame")
    return recorder
