"""Read the calibration from a bag: intrinsics, distortion, the depth camera's pose, and the depth unit.

Intrinsics are in sensor_msgs/CameraInfo beside the images (camera_info). Camera poses are in /tf_static or /tf, between
the frames that the images name. RealSense's SDK before version 2.58 uses its own topics /device_0/sensor_0/Depth_0/…
(librealsense, ros_file_format.h): info/camera_info, tf/N (a geometry_msgs/Transform from a reference to the stream) and
option/Depth_Units/value of the sensor.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import MM_PER_METRE, Calibration, Distortion, build_camera, resolve_calibration
from sigmasplat.plugins.sources.ros.bag import Bag, Message
from sigmasplat.plugins.sources.ros.tf import lookup_transform, transform_of
from sigmasplat.plugins.sources.ros.topics import ImageTopic
from sigmasplat.types import Matrix

BROWN_CONRADY = ("", "plumb_bob", "brown conrady", "inverse brown conrady", "modified brown conrady", "none")
RATIONAL = "rational_polynomial"


@dataclass(frozen=True)
class Optics:
    """Intrinsics and lens distortion, None for no distortion."""

    camera: Camera
    lens: Distortion | None


def read_bag_calibration(bag: Bag, color: ImageTopic, depth: ImageTopic, settings: InputConfig) -> Calibration:
    """Return the calibration of a bag; the settings override it.

    Raises SourceError if the colour camera is unknown, or if the pose of a separate depth camera is unknown.
    """
    optics = read_optics(bag, color)
    units = depth_units(bag, depth)
    recorded = Calibration(optics.camera, units, optics.lens) if optics else None
    calibration = resolve_calibration(bag.path, recorded, color.size, settings, units)
    decided = settings.calibration or calibration.depth_camera or settings.register_depth == "off"
    if decided or is_registered(color, depth):
        return calibration
    depth_optics = read_optics(bag, depth)
    if depth_optics is None and depth.size == color.size:
        return calibration  # assumed to be registered; `inspect` compares edges
    if depth_optics is None:
        raise SourceError(
            f"{bag.path}: {depth.name} has no camera_info, so it cannot be registered to {color.name}; record it too, "
            "or give --calibration FILE with depth_camera and T_color_depth"
        )
    return replace(
        calibration,
        depth_camera=depth_optics.camera,
        depth_distortion=depth_optics.lens,
        T_color_depth=_color_depth(bag, color, depth),
    )


def is_registered(color: ImageTopic, depth: ImageTopic) -> bool:
    """Return whether depth is registered to colour: by its topic name, or by an equal optical frame."""
    return depth.registered or (bool(depth.frame) and depth.frame == color.frame and not sdk_stream(depth))


def read_optics(bag: Bag, topic: ImageTopic) -> Optics | None:
    """Read the CameraInfo of an image topic; None if it is missing or empty. Raises SourceError if it is damaged."""
    name = _info_name(bag, topic)
    if name is None:
        return None
    info = bag.first_message(name)
    rectified, where = "rect" in topic.base.rpartition("/")[2], bag.path / name.lstrip("/")
    k = np.asarray(_field(info, "p")).reshape(3, 4)[:, :3] if rectified else np.asarray(_field(info, "k")).reshape(3, 3)
    if rectified and k[0, 0] <= 0:
        k = np.asarray(_field(info, "k")).reshape(3, 3)
    if k[0, 0] <= 0:
        return None
    width, height = int(info.width) or topic.size[0], int(info.height) or topic.size[1]
    camera = build_camera(where, width, height, [float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])])
    return Optics(camera, None if rectified else _lens(f"{bag.path}: {name}", info))


def _info_name(bag: Bag, topic: ImageTopic) -> str | None:
    infos = {info.name for info in bag.topics_of_type("sensor_msgs/msg/CameraInfo")}
    names = (f"{topic.camera}/camera_info", f"{topic.base.removesuffix('/image/data')}/info/camera_info")
    return next((name for name in names if name in infos), None)


def info_of(bag: Bag, topic: ImageTopic) -> Matrix | None:
    """Return the projection P [3, 4] of an image topic's CameraInfo, None without one."""
    name = _info_name(bag, topic)
    if name is None:
        return None
    return np.asarray(_field(bag.first_message(name), "p"), np.float64).reshape(3, 4)


def depth_units(bag: Bag, depth: ImageTopic) -> float:
    """Return the depth units per metre: from the SDK's option if it was recorded, else for millimetres."""
    sensor = "/".join(depth.name.split("/")[:3])
    name = f"{sensor}/option/Depth_Units/value"
    if name not in bag.topics or not bag.topics[name].count:
        return MM_PER_METRE  # ROS depth as whole numbers is in millimetres (REP 118)
    metres = float(bag.first_message(name).data)
    return round(1.0 / metres, 3) if metres > 0 else MM_PER_METRE


def _color_depth(bag: Bag, color: ImageTopic, depth: ImageTopic) -> Matrix:
    found = _sdk_color_depth(bag, color, depth)
    if found is None and color.frame and depth.frame:
        found = lookup_transform(bag, color.frame, depth.frame)
    if found is None:
        raise SourceError(
            f"{bag.path}: no transform from the depth camera ({depth.frame or depth.name}) to the colour camera "
            f"({color.frame or color.name}); record /tf_static or an aligned depth topic, "
            "or give --calibration FILE with depth_camera and T_color_depth"
        )
    return found


def sdk_stream(topic: ImageTopic) -> str:
    """Return the SDK's name of a stream, such as /device_0/sensor_0/Depth_0, or "" for other bags."""
    return topic.base.removesuffix("/image/data") if topic.base.startswith("/device_") else ""


def _sdk_color_depth(bag: Bag, color: ImageTopic, depth: ImageTopic) -> Matrix | None:
    poses = [sdk_pose(bag, sdk_stream(topic)) for topic in (color, depth)]
    T_color_reference, T_depth_reference = poses
    if T_color_reference is None or T_depth_reference is None:
        return None
    return T_color_reference @ se3.inverse(T_depth_reference)


def sdk_pose(bag: Bag, stream: str) -> Matrix | None:
    """Return T_stream_reference, None if the bag is not from the SDK."""
    found = bag.topics_of_type("geometry_msgs/msg/Transform")
    names = [topic.name for topic in found if topic.name.startswith(f"{stream}/tf/")]
    if not (stream and names):
        return None
    message = bag.first_message(names[0])
    return transform_of(f"{bag.path}: {names[0]}", message.translation, message.rotation)


def _lens(where: str, info: Message) -> Distortion | None:
    """Return the distortion in OpenCV's order. Raises SourceError for an unsupported model."""
    values = [float(v) for v in _field(info, "d")]
    if not any(values):
        return None
    model = info.distortion_model.lower()
    if model not in (*BROWN_CONRADY, RATIONAL) or len(values) < 4:
        raise SourceError(
            f"{where}: lens model {info.distortion_model} is not supported (plumb_bob and {RATIONAL} are); "
            "record the rectified images (image_rect_color), or give --calibration FILE"
        )
    return tuple([*values, 0.0][: 8 if model == RATIONAL else 5])


def _field(message: Message, name: str) -> Iterable[float]:
    """Read a field whose name is in capitals in ROS 1 and in lower case in ROS 2."""
    values: Iterable[float] = getattr(message, name if hasattr(message, name) else name.upper())
    return values
