"""Choose the topics of a bag, and read its calibration.

Intrinsics are in sensor_msgs/CameraInfo beside the images (camera_info). Camera poses are in tf2_msgs/TFMessage of
/tf_static or /tf, between the frames that the images name. RealSense's SDK before 2.58 uses topics of its own below
/device_0/sensor_0/Depth_0/ (librealsense, ros_file_format.h): info/camera_info, tf/N, option/Depth_Units/value.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Calibration, Distortion, Matrix, SourceError, se3
from sigmasplat.plugins.sources import bag_messages
from sigmasplat.plugins.sources.bag_messages import COMPRESSED, RAW, Bag, ImageKind, Message, image_kind

MAX_TF_MESSAGES = 2000
"""Number of messages of /tf to read; transforms between the cameras of one device are repeated."""


def lookup_transform(bag: Bag, target: str, source: str, use_tf: bool = True) -> Matrix | None:
    """Return T_target_source [4, 4] from the bag's transforms, None if they do not connect the frames.

    `use_tf`: whether to read the first messages of /tf too; old drivers repeat static transforms there.
    """
    edges: dict[str, dict[str, Matrix]] = {}
    for name, most in (("/tf_static", None), ("/tf", MAX_TF_MESSAGES)):
        if name not in bag.topics or not (use_tf or most is None):
            continue
        for message in islice(bag.messages(name), most):
            for link in message.transforms:
                parent, child = link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/")
                T = transform_of(f"{bag.path}: {name}: {parent} to {child}", link.transform)
                edges.setdefault(parent, {}).setdefault(child, T)
                edges.setdefault(child, {}).setdefault(parent, se3.inverse(T))
        if (found := chained(edges, target, source)) is not None:
            return found
    return None


def transform_of(where: str, message: Message) -> Matrix:
    """Build a transform of a geometry_msgs/Transform. Raises SourceError naming `where` unless it is rigid."""
    t, q = message.translation, message.rotation
    return api.rigid_transform(where, [t.x, t.y, t.z], [q.w, q.x, q.y, q.z])


def chained(edges: dict[str, dict[str, Matrix]], target: str, source: str) -> Matrix | None:
    """Return T_target_source by breadth-first search from the target, None if the source is not connected."""
    reached = {target: np.eye(4)}
    queue = [target]
    for frame in queue:
        for neighbour, T in edges.get(frame, {}).items():
            if neighbour not in reached:
                reached[neighbour] = reached[frame] @ T
                queue.append(neighbour)
    return reached.get(source)


REGISTERED_NAMES = ("aligned_depth_to_color", "depth_registered", "depth_to_rgb")
"""Parts of topic names for depth registered to colour (RealSense; OpenNI, Kinect; Azure Kinect)."""
NOT_DEPTH_NAMES = ("infra", "/ir/", "confidence")
NOT_GRAY_NAMES = ("confidence", "mask", "label", "segment", "semantic", "disparity", "depth")
"""Parts of topic names for 16-bit images that are not depth, and for 8-bit images that no camera took."""


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images: kind, optical frame, (width, height) and encoding of the first image."""

    name: str
    kind: ImageKind
    frame: str
    size: tuple[int, int]
    encoding: str

    @property
    def base(self) -> str:
        """The topic name without the suffix that image_transport adds to compressed images."""
        return self.name.removesuffix("/compressedDepth").removesuffix("/compressed")

    @property
    def camera(self) -> str:
        """The name space of all images of one camera."""
        return self.base.rpartition("/")[0]

    @property
    def registered(self) -> bool:
        """Whether its name says that depth is registered to colour."""
        return any(words in self.name for words in REGISTERED_NAMES)


def color_topic(bag: Bag, requested: str) -> ImageTopic:
    """Return the requested topic, else the only one with colour or gray images. Raises SourceError as `depth_topic`."""
    found = [topic_by_name(bag, requested)] if requested else image_topics(bag, "colour")
    found = found or image_topics(bag, "gray", NOT_GRAY_NAMES)
    for i, t in enumerate(found):
        if t.kind == "gray" or (t.encoding.startswith(("16UC1", "mono16")) and "depth" not in t.name.lower()):
            found[i] = replace(t, kind="colour")
    named = [topic for topic in found if any(word in topic.name.lower() for word in ("color", "rgb"))]
    return _one_camera(bag, "colour", named or found, "color")


def depth_topic(bag: Bag, requested: str, color: ImageTopic) -> ImageTopic:
    """Return the requested topic, or the only one with depth, not `color`; depth registered to colour is preferred.

    Raises SourceError if there is no such topic or more than one.
    """
    if requested:
        return _one_camera(bag, "depth", [topic_by_name(bag, requested)], "depth")
    found = [topic for topic in image_topics(bag, "depth", NOT_DEPTH_NAMES) if topic.name != color.name]
    return _one_camera(bag, "depth", [topic for topic in found if topic.registered] or found, "depth")


def image_topics(bag: Bag, kind: ImageKind, other_names: Sequence[str] = ()) -> list[ImageTopic]:
    """Return the topics whose first message is of this kind, without names that contain one of `other_names`."""
    found = [_described(bag, topic.name) for topic in bag.topics_of_type(RAW, COMPRESSED)]
    return [t for t in found if t.kind == kind and not any(word in t.name.lower() for word in other_names)]


def topic_by_name(bag: Bag, name: str) -> ImageTopic:
    """Return a topic by name. Raises SourceError if it does not exist or holds no images."""
    topics = {topic.name: topic for topic in bag.topics_of_type(RAW, COMPRESSED)}
    name = name if name in topics else f"/{name}"
    if name not in topics:
        raise SourceError(
            f"{bag.path}: no images in topic {name}{api.nearest(name, list(topics))}; "
            f"there are {bag_messages.list_topics(topics.values())}"
        )
    return _described(bag, name)


def _described(bag: Bag, name: str) -> ImageTopic:
    message = bag.first_message(name)
    size, (kind, encoding) = bag_messages.message_size(bag.path / name.lstrip("/"), message), image_kind(message)
    return ImageTopic(name, kind, message.header.frame_id.lstrip("/"), size, encoding)


def _one_camera(bag: Bag, what: str, topics: list[ImageTopic], option: str) -> ImageTopic:
    """Return the topic of the only camera: rectified before raw, uncompressed before compressed."""
    if not topics or any(topic.kind != what for topic in topics):
        images = topics or [_described(bag, topic.name) for topic in bag.topics_of_type(RAW, COMPRESSED)]
        stored = "".join(f"; {image.name} is encoded as {image.encoding}" for image in images[:4])
        raise SourceError(
            f"{bag.path}: no {what} images in {topics[0].name if topics else 'any topic'}; "
            f"the bag holds {bag_messages.list_topics(bag.topics.values())}{stored}; record colour as rgb8, mono8 or "
            f"JPEG and depth as 16UC1 or 32FC1 (republish RVL as PNG), or choose another topic: --{option}-topic NAME"
        )
    cameras = sorted({topic.camera for topic in topics})
    if len(cameras) > 1:
        names = ", ".join(sorted(topic.name for topic in topics))
        raise SourceError(f"{bag.path}: several topics hold {what} images ({names}); choose one: --{option}-topic NAME")
    return min(topics, key=lambda topic: ("rect" not in topic.base, topic.base != topic.name, topic.name))


BROWN_CONRADY = ("", "plumb_bob", "brown conrady", "inverse brown conrady", "modified brown conrady", "none")
RATIONAL = "rational_polynomial"

Optics = tuple[api.Camera, Distortion | None]
"""Intrinsics, and lens distortion or None."""


def read_bag_calibration(bag: Bag, color: ImageTopic, depth: ImageTopic, settings: api.InputConfig) -> Calibration:
    """Return the calibration of a bag; the settings override it.

    Raises SourceError if the colour camera is unknown, or if the pose of a separate depth camera is unknown.
    """
    optics = None
    with suppress(*[SourceError] * bool(settings.calibration)):  # that of the file replaces it
        optics = read_optics(bag, color)
    units = _depth_units(bag, depth)
    recorded = Calibration(optics[0], units, optics[1]) if optics else None
    calibration = api.resolve_calibration(bag.path, recorded, color.size, settings, units)
    decided = settings.calibration or calibration.depth_camera or settings.register_depth == "off"
    same_frame = bool(depth.frame) and depth.frame == color.frame and not sdk_stream(depth)
    if decided or depth.registered or same_frame:
        return calibration
    depth_optics = read_optics(bag, depth)
    if depth_optics is None and depth.size == color.size:
        return calibration  # assumed to be registered; `inspect` compares edges
    if depth_optics is None:
        raise SourceError(
            f"{bag.path}: {depth.name} has no camera_info, so it cannot be registered to {color.name}; record it too, "
            "or give --calibration FILE with depth_camera and T_color_depth"
        )
    camera, lens = depth_optics
    T_color_depth = _color_depth(bag, color, depth)
    return replace(calibration, depth_camera=camera, depth_distortion=lens, T_color_depth=T_color_depth)


def read_optics(bag: Bag, topic: ImageTopic) -> Optics | None:
    """Read the CameraInfo of an image topic; None if it is missing or empty. Raises SourceError if it is damaged."""
    infos = {info.name for info in bag.topics_of_type("sensor_msgs/msg/CameraInfo")}
    names = [f"{topic.camera}/camera_info", f"{topic.base.removesuffix('/image/data')}/info/camera_info"]
    beside = (name for name in [*names, f"{topic.base}/camera_info"] if name in infos)
    of_frame = (n for n in sorted(infos) if topic.frame == bag.first_message(n).header.frame_id.lstrip("/") != "")
    if (name := next(chain(beside, of_frame), None)) is None:
        return None
    first = islice(bag.messages(name), MAX_TF_MESSAGES)  # a driver may start with zeros
    info = next((message for message in first if next(iter(_field(message, "k")))), bag.first_message(name))
    rectified, where = "rect" in topic.base.rpartition("/")[2], bag.path / name.lstrip("/")
    k = np.asarray(_field(info, "p")).reshape(3, 4)[:, :3]
    if not rectified or k[0, 0] <= 0:
        k = np.asarray(_field(info, "k")).reshape(3, 3)
    if k[0, 0] <= 0:
        return None
    width, height = int(info.width) or topic.size[0], int(info.height) or topic.size[1]
    camera = api.build_camera(where, width, height, [float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])])
    return camera, None if rectified else _lens(f"{bag.path}: {name}", info)


def _depth_units(bag: Bag, depth: ImageTopic) -> float:
    """Return the depth units per metre: from the SDK's option if it was recorded, else for millimetres."""
    sensor = "/".join(depth.name.split("/")[:3])
    name = f"{sensor}/option/Depth_Units/value"
    if name not in bag.topics or not bag.topics[name].count:
        return api.MM_PER_METRE  # ROS depth as whole numbers is in millimetres (REP 118)
    metres = float(bag.first_message(name).data)
    return round(1.0 / metres, 3) if metres > 0 else api.MM_PER_METRE


def _color_depth(bag: Bag, color: ImageTopic, depth: ImageTopic) -> Matrix:
    found = sdk_transform(bag, color, depth)
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


def sdk_transform(bag: Bag, target: ImageTopic, source: ImageTopic | str) -> Matrix | None:
    """Return T_target_source between two streams, None if the bag is not from the SDK; source: a topic or a stream."""
    stream = source if isinstance(source, str) else sdk_stream(source)
    T_target_reference, T_source_reference = _sdk_pose(bag, sdk_stream(target)), _sdk_pose(bag, stream)
    if T_target_reference is None or T_source_reference is None:
        return None
    return np.asarray(T_target_reference @ se3.inverse(T_source_reference))


def _sdk_pose(bag: Bag, stream: str) -> Matrix | None:
    """Return T_stream_reference, None if the bag is not from the SDK."""
    found = bag.topics_of_type("geometry_msgs/msg/Transform")
    names = [topic.name for topic in found if topic.name.startswith(f"{stream}/tf/")]
    if not (stream and names):
        return None
    return transform_of(f"{bag.path}: {names[0]}", bag.first_message(names[0]))


def _lens(where: str, info: Message) -> Distortion | None:
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
