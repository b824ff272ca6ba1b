"""Make ROS 2 messages from poses and images, as bytes (CDR), through the rosbags package (Apache-2.0).

Stamps are the times of the frames, nanoseconds. Coordinate frames are those of REP 105 (map, odom) and REP 103 (x
forward, y left, z up; optical frames z forward):

    map ─ odom ─ camera_link ─ camera_optical_frame
     └─ sigmasplat_world      the world of SigmaSplat: the camera of the first frame

Only map → odom contains corrections (loops, relocalisation, mapping), so odom → camera_link is continuous.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Camera, Matrix, import_optional, se3

MAP, ODOM, LINK, OPTICAL = "map", "odom", "camera_link", "camera_optical_frame"
WORLD = "sigmasplat_world"

T_LINK_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From optical axes (x right, y down, z forward) to those of a body (x forward, y left, z up); the origin is shared."""
T_MAP_WORLD = T_LINK_OPTICAL
"""From the world to the map while a run goes on: the first camera is assumed to be level."""


def link_pose(T_outer_optical: Matrix) -> Matrix:
    """Return the pose of camera_link, given that of the optical frame in the same outer frame [..., 4, 4]."""
    return np.asarray(T_outer_optical @ se3.inverse(T_LINK_OPTICAL))


EXTRA = "ros"
UNKNOWN = (-1.0, *(0.0,) * 35)
"""Covariance that is not known: ROS marks it by −1 in the first element."""


class Topic(NamedTuple):
    """A topic: its name, its message type, and whether late subscribers get the last message (transient local)."""

    name: str
    msgtype: str
    latched: bool = False


TF = Topic("/tf", "tf2_msgs/msg/TFMessage")
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", True)
ODOMETRY = Topic("/sigmasplat/odometry", "nav_msgs/msg/Odometry")
COLOR = Topic("/camera/color/image_raw", "sensor_msgs/msg/Image")
COLOR_INFO = Topic("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo")
DEPTH = Topic("/camera/aligned_depth_to_color/image_raw", "sensor_msgs/msg/Image")
DEPTH_INFO = Topic("/camera/aligned_depth_to_color/camera_info", "sensor_msgs/msg/CameraInfo")
TOPICS = (TF, TF_STATIC, ODOMETRY, COLOR, COLOR_INFO, DEPTH, DEPTH_INFO)


class Encoded(NamedTuple):
    """A message as CDR bytes, with its topic and the time of its frame."""

    topic: Topic
    stamp_ns: int
    data: bytes


def stamp_of(timestamp_s: float) -> int:
    """Return a time in nanoseconds; ROS has no negative times."""
    return max(0, round(timestamp_s * 1e9))


def _xyz(values: Matrix) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _rotation(T: Matrix) -> dict[str, float]:
    return dict(zip("wxyz", map(float, se3.quaternion_from_rotation(T[:3, :3])), strict=True))


def _header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


class RosMessages:
    """Makes messages. Raises SourceError without the rosbags package."""

    def __init__(self) -> None:
        typesys = import_optional("rosbags.typesys", EXTRA, "ROS messages")
        self._nodes = import_optional("rosbags.interfaces", EXTRA, "ROS messages").Nodetype
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def transforms(self, topic: Topic, stamp_ns: int, links: Sequence[tuple[str, str, Matrix]]) -> Encoded:
        """Make a message of transforms (parent, child, T_parent_child [4, 4])."""
        stamped = [
            {
                "header": _header(stamp_ns, parent), "child_frame_id": child,
                "transform": {"translation": _xyz(T[:3, 3]), "rotation": _rotation(T)},
            }
            for parent, child, T in links
        ]  # fmt: skip
        return self._encoded(topic, stamp_ns, "", transforms=stamped)

    def odometry(self, stamp_ns: int, parent: str, child: str, T: Matrix) -> Encoded:
        """Make nav_msgs/Odometry: the pose T_parent_child. Its covariance and that of velocities, which are not
        estimated, are marked as not known."""
        unknown = {"covariance": np.array(UNKNOWN)}
        pose = {"pose": {"position": _xyz(T[:3, 3]), "orientation": _rotation(T)}, **unknown}
        return self._encoded(ODOMETRY, stamp_ns, parent, child_frame_id=child, pose=pose, twist=unknown)

    def images(
        self, stamp_ns: int, camera: Camera, color: NDArray[np.float32], depth_m: NDArray[np.float32]
    ) -> list[Encoded]:
        """Make two sensor_msgs/Image and their CameraInfo: colour [H, W, 3] in [0, 1] as rgb8, depth [H, W] m as 32FC1
        with nan where there is no reading (REP 118)."""
        rgb = np.rint(255.0 * color).astype(np.uint8)
        depth = np.where(depth_m > 0, depth_m, np.float32(np.nan)).astype("<f4")
        size = {"height": camera.height, "width": camera.width}
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        P = np.pad(K, ((0, 0), (0, 1)))
        pinhole = {"d": np.zeros(5), "k": K.reshape(-1), "r": np.eye(3).reshape(-1), "p": P.reshape(-1)}
        found = []
        for topic, about, array, kind in ((COLOR, COLOR_INFO, rgb, "rgb8"), (DEPTH, DEPTH_INFO, depth, "32FC1")):
            data, step = np.ascontiguousarray(array).reshape(-1).view(np.uint8), array.nbytes // camera.height
            found += [
                self._encoded(about, stamp_ns, OPTICAL, distortion_model="plumb_bob", **size, **pinhole),
                self._encoded(topic, stamp_ns, OPTICAL, encoding=kind, step=step, data=data, **size),
            ]
        return found

    def _encoded(self, topic: Topic, stamp_ns: int, frame: str, **values: Any) -> Encoded:
        message = self._made(topic.msgtype, {"header": _header(stamp_ns, frame), **values})
        return Encoded(topic, stamp_ns, bytes(self.store.serialize_cdr(message, topic.msgtype)))

    def _made(self, kind: str, values: Mapping[str, Any]) -> Any:
        """Make a message from nested values; fields that are left out are zero or empty."""
        fields = {}
        for name, (node, detail) in self.store.fielddefs[kind][1]:
            value = values.get(name)
            if node == self._nodes.NAME:
                value = self._made(detail, value or {})
            elif node == self._nodes.SEQUENCE and detail[0][0] == self._nodes.NAME:
                value = [self._made(detail[0][1], item) for item in value or ()]
            elif value is None:
                value = "" if detail[0] == "string" else 0
            fields[name] = value
        return self.store.types[kind](**fields)
