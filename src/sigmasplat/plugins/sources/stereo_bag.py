"""Read the infrared pair of a RealSense from a bag as a stereo pair.

Used if the bag has no depth, or if input.depth_topic names the right one of two infrared topics. The rectified images
of ROS (infra1/image_rect_raw) and the streams of RealSense's SDK (Infrared_1) have CameraInfo; the baseline is in P of
the right camera, in the transforms of the SDK's streams, or in /tf_static.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.input.association import MAX_GAP_S, associate, no_pairs
from sigmasplat.input.recorded import Size
from sigmasplat.plugins.sources.camera.stereo_cameras import StereoCameras
from sigmasplat.plugins.sources.ros.bag import Bag, Entry
from sigmasplat.plugins.sources.ros.cameras import Optics, info_of, read_optics, sdk_pose, sdk_stream
from sigmasplat.plugins.sources.ros.images import decode_any_color, message_size
from sigmasplat.plugins.sources.ros.tf import lookup_transform
from sigmasplat.plugins.sources.ros.topics import ImageTopic, image_topics, topic_by_name
from sigmasplat.plugins.sources.ros.truth import read_truth
from sigmasplat.plugins.sources.stereo import StereoPair, StereoRig, StereoSource, given_intrinsics
from sigmasplat.types import Matrix

PAIRS = (("infra1", "infra2"), ("Infrared_1", "Infrared_2"), ("/left/", "/right/"))
"""Parts of the names of left and right topics: RealSense with ROS, RealSense's SDK, other stereo cameras."""


@dataclass(frozen=True)
class BagStereoPair(StereoPair):
    """Two messages; the paths contain bag, topic and time."""

    bag: Bag
    messages: Mapping[Path, tuple[str, Entry]]

    def decoded(self, path: Path) -> NDArray[np.uint8]:
        """Read an image, RGB [H, W, 3]. Raises SourceError naming topic and time."""
        return decode_any_color(path, self.bag.read(*self.messages[path]))

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of both images. Raises SourceError naming topic and time."""
        left, right = (message_size(path, self.bag.read(*self.messages[path])) for path in (self.color, self.depth))
        return left, right


def stereo_topics(bag: Bag, settings: InputConfig) -> tuple[ImageTopic, ImageTopic] | None:
    """Return the left and the right topic of a bag that is read as stereo, else None.

    With both topics requested, they are the pair if the second one is not depth. Without, there must be no depth.
    """
    if settings.color_topic and settings.depth_topic:
        left, right = (topic_by_name(bag, name) for name in (settings.color_topic, settings.depth_topic))
        return None if right.kind == "depth" and not _is_right(right.name) else (left, right)
    if settings.color_topic or settings.depth_topic:
        return None
    if any("depth" in topic.name.lower() or not _is_side(topic.name) for topic in image_topics(bag, "depth")):
        return None
    found = {topic.name: topic for kind in ("", "colour", "depth") for topic in image_topics(bag, kind)}
    for of_left, of_right in PAIRS:
        for name in sorted(found, key=lambda name: ("compressed" in name, "rect" not in name, name)):
            if of_left in name and name.replace(of_left, of_right) in found:
                return found[name], found[name.replace(of_left, of_right)]
    return None


def _is_side(name: str) -> bool:
    return any(side in name for pair in PAIRS for side in pair)


def _is_right(name: str) -> bool:
    return any(right in name for _, right in PAIRS)


def open_stereo_bag(bag: Bag, left: ImageTopic, right: ImageTopic, settings: InputConfig) -> StereoSource:
    """Open two topics of a bag as a stereo pair. Raises SourceError if cameras or baseline are unknown."""
    cameras = _cameras(bag, left, right, settings)
    found = bag.index(left.name, right.name)
    times = [np.array([entry.stamp_ns / 1e9 for entry in found[topic.name]]) for topic in (left, right)]
    indices = associate(times[0], times[1])
    if not len(indices):
        raise no_pairs(bag.path, {"left": times[0], "right": times[1]})
    paths = [
        [bag.path / f"{topic.name.lstrip('/')} at {t:.3f} s, {k}" for k, t in enumerate(of_topic)]
        for topic, of_topic in zip((left, right), times, strict=True)
    ]
    messages = {
        path: (topic.name, entry)
        for topic, named in zip((left, right), paths, strict=True)
        for path, entry in zip(named, found[topic.name], strict=True)
    }

    def pair_of(time_s: float, one: Path, other: Path, rig: StereoRig) -> BagStereoPair:
        return BagStereoPair(time_s, one, other, rig, bag, messages)

    pairs = [(float(times[0][i]), paths[0][i], paths[1][j]) for i, j in indices]
    alone = sorted(set(range(len(times[0]))) - set(indices[:, 0].tolist()))
    skipped = [f"{paths[0][i]}: no right image within {MAX_GAP_S:g} s" for i in alone]
    truth = read_truth(bag, left.frame, False)
    return StereoSource(bag.path.resolve().stem, pairs, cameras, settings, truth, skipped, pair_of)


def _cameras(bag: Bag, left: ImageTopic, right: ImageTopic, settings: InputConfig) -> StereoCameras:
    optics: list[Optics] = []
    for topic in (left, right):
        known = read_optics(bag, topic)
        if known is None:
            raise SourceError(f"{bag.path}: {topic.name} has no camera_info; record it beside the images")
        optics.append(known)
    T_right_left = _rig(bag, left, right)
    lenses = [known.lens if settings.undistort else None for known in optics]
    return StereoCameras(given_intrinsics(optics[0].camera, settings), optics[1].camera, T_right_left, *lenses)


def _rig(bag: Bag, left: ImageTopic, right: ImageTopic) -> Matrix:
    poses = [sdk_pose(bag, sdk_stream(topic)) for topic in (left, right)]
    if poses[0] is not None and poses[1] is not None:
        return np.asarray(poses[1] @ se3.inverse(poses[0]))
    P = np.zeros((3, 4)) if (info := info_of(bag, right)) is None else info
    T_right_left = np.eye(4)
    if P[0, 0] > 0 and P[0, 3] < 0:
        T_right_left[0, 3] = P[0, 3] / P[0, 0]
        return T_right_left
    found = lookup_transform(bag, right.frame, left.frame) if left.frame and right.frame else None
    if found is None or not np.linalg.norm(found[:3, 3]):
        raise SourceError(
            f"{bag.path}: the baseline of {left.name} and {right.name} is unknown; record camera_info with P, or "
            "/tf_static"
        )
    return found
