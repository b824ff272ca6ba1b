"""Make ROS 2 messages from poses, maps and images, as bytes (CDR), through the rosbags package (Apache-2.0).

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
from torch import Tensor

from sigmasplat.api import Camera, GaussianField, Matrix, import_optional, se3
from sigmasplat.plugins.outputs.floorplan.floor_plan import FREE, OBJECT, WALL, FloorPlan
from sigmasplat.plugins.outputs.views import opaque_rows

MAP, ODOM, LINK, OPTICAL = "map", "odom", "camera_link", "camera_optical_frame"
WORLD = "sigmasplat_world"

T_LINK_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From optical axes (x right, y down, z forward) to those of a body (x forward, y left, z up); the origin is shared."""
T_MAP_WORLD = T_LINK_OPTICAL
"""From the world to the map while a run goes on: the first camera is assumed to be level."""
T_BODY_FLOOR = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""From the axes of the floor plan (x right, y ahead, z up) to x ahead, y left, z up."""


def levelled_map(T_floor_world: Matrix) -> Matrix:
    """Return T_map_world [4, 4] for a known floor: x ahead, y left, z up, origin on the floor below the first camera.

    T_floor_world: that of `FloorPlan`.
    """
    return np.asarray(T_BODY_FLOOR @ T_floor_world)


def link_pose(T_outer_optical: Matrix) -> Matrix:
    """Return the pose of camera_link, given that of the optical frame in the same outer frame [..., 4, 4]."""
    return np.asarray(T_outer_optical @ se3.inverse(T_LINK_OPTICAL))


def camera_links(T_odom_link: Matrix, T_map_link: Matrix | None) -> list[tuple[str, str, Matrix]]:
    """Return the transforms of a frame as (parent, child, pose): map → odom, left out if T_map_link is None, and odom →
    camera_link."""
    links = [(ODOM, LINK, T_odom_link)]
    if T_map_link is not None:
        links.insert(0, (MAP, ODOM, se3.orthonormalise(T_map_link @ se3.inverse(T_odom_link))))
    return links


def ros_covariance(covariance: Matrix, T_outer_world: Matrix, T_outer_link: Matrix) -> Matrix:
    """Return the covariance [6, 6] as in geometry_msgs/PoseWithCovariance: x, y, z, rotation about x, y, z, all in the
    axes of the outer frame.

    covariance [6, 6]: of the left twist (ρ, φ), m and rad, of the pose in the world; T_outer_world [4, 4]: from the
    world to the outer frame; T_outer_link [4, 4]: the pose in the outer frame.
    """
    J = se3.displacement(T_outer_link) @ se3.adjoint(T_outer_world)
    return np.asarray(J @ covariance @ J.T)


EXTRA = "ros"
KNOWN_VARIANCE = 1e-10
"""Variance written for a pose that is known exactly (10 µm, 10 µrad), because readers invert covariances."""
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
POSE = Topic("/sigmasplat/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
CLOUD = Topic("/sigmasplat/cloud", "sensor_msgs/msg/PointCloud2", True)
GRID = Topic("/map", "nav_msgs/msg/OccupancyGrid", True)
COLOR = Topic("/camera/color/image_raw", "sensor_msgs/msg/Image")
COLOR_INFO = Topic("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo")
DEPTH = Topic("/camera/aligned_depth_to_color/image_raw", "sensor_msgs/msg/Image")
DEPTH_INFO = Topic("/camera/aligned_depth_to_color/camera_info", "sensor_msgs/msg/CameraInfo")
TOPICS = (
    TF, TF_STATIC, ODOMETRY, POSE, CLOUD, GRID, COLOR, COLOR_INFO, DEPTH, DEPTH_INFO,
)  # fmt: skip


MAX_POINTS = 200_000
UNOBSERVED, EMPTY, OCCUPIED = -1, 0, 100
"""Values of nav_msgs/OccupancyGrid."""


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


def _pose(T: Matrix) -> dict[str, Any]:
    return {"position": _xyz(T[:3, 3]), "orientation": _rotation(T)}


def _pose_with_covariance(T: Matrix, covariance: Matrix | None) -> dict[str, Any]:
    values = np.array(UNKNOWN)
    if covariance is not None:
        values = (covariance if covariance.any() else KNOWN_VARIANCE * np.eye(6)).reshape(-1).astype(np.float64)
    return {"pose": _pose(T), "covariance": values}


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

    def odometry(self, stamp_ns: int, parent: str, child: str, T: Matrix, covariance: Matrix | None) -> Encoded:
        """Make nav_msgs/Odometry: the pose T_parent_child with covariance [6, 6] (`ros_covariance`), None if it
        is not known. Velocities are not estimated: their covariance is marked as not known."""
        pose, twist = _pose_with_covariance(T, covariance), {"covariance": np.array(UNKNOWN)}
        return self._encoded(ODOMETRY, stamp_ns, parent, child_frame_id=child, pose=pose, twist=twist)

    def pose(self, stamp_ns: int, parent: str, T: Matrix, covariance: Matrix | None) -> Encoded:
        """Make geometry_msgs/PoseWithCovarianceStamped, arguments as for `odometry`."""
        return self._encoded(POSE, stamp_ns, parent, pose=_pose_with_covariance(T, covariance))

    def cloud(
        self, stamp_ns: int, frame: str, field: GaussianField, depth_std_m: Tensor | None, T_frame_field: Matrix
    ) -> Encoded:
        """Make sensor_msgs/PointCloud2 of the centres of the opaque splats, evenly thinned to `MAX_POINTS`: x, y, z,
        rgb, opacity, depth_std (m, nan if not known).

        depth_std_m [N]: standard deviation of the depth that each splat shows; None if it was not measured.
        """
        names, chosen = ("x", "y", "z", "rgb", "opacity", "depth_std"), opaque_rows(field, MAX_POINTS)
        means, colors, opacities = (
            values.detach().cpu().numpy()[chosen] for values in (field.means, field.colors, field.opacities)
        )
        rows = np.zeros(len(chosen), [(name, "<f4") for name in names])
        positions = means.astype(np.float64) @ T_frame_field[:3, :3].T + T_frame_field[:3, 3]
        rows["x"], rows["y"], rows["z"] = positions.T
        red, green, blue = (np.rint(255.0 * np.clip(colors, 0.0, 1.0))).astype(np.uint32).T
        rows["rgb"] = (red << 16 | green << 8 | blue).view("<f4")
        rows["opacity"] = opacities
        rows["depth_std"] = np.nan if depth_std_m is None else depth_std_m.cpu().numpy()[chosen]
        size = rows.dtype.itemsize
        fields = [{"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate(names)]
        return self._encoded(
            CLOUD, stamp_ns, frame, height=1, width=len(rows), fields=fields, point_step=size,
            row_step=size * len(rows), data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=bool(np.isfinite(positions).all()),
        )  # fmt: skip

    def grid(self, stamp_ns: int, frame: str, plan: FloorPlan) -> Encoded:
        """Make nav_msgs/OccupancyGrid of a floor plan: 0 free floor, 100 object or wall, −1 not observed, also where
        only the floor was not observed.

        frame: the frame with the axes of `levelled_map`. The grid is not rotated in it, because navigation software
        ignores the rotation of a grid. Columns grow along x, rows along y.
        """
        occupied = np.full(plan.kind.shape, UNOBSERVED, np.int8)
        occupied[plan.kind == FREE] = EMPTY
        occupied[(plan.kind == OBJECT) | (plan.kind == WALL)] = OCCUPIED
        cells, T_frame_grid = np.ascontiguousarray(occupied.T[::-1]), np.eye(4)
        # x ahead is y of the plan, y left is −x of the plan
        T_frame_grid[:2, 3] = plan.origin_m[1], -(plan.origin_m[0] + plan.cell_m * plan.kind.shape[1])
        info = {
            "map_load_time": _header(stamp_ns, "")["stamp"], "resolution": plan.cell_m, "width": cells.shape[1],
            "height": cells.shape[0], "origin": _pose(T_frame_grid),
        }  # fmt: skip
        return self._encoded(GRID, stamp_ns, frame, info=info, data=cells.reshape(-1))

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
