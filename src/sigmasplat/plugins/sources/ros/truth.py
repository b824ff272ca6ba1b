"""Read the ground-truth path of a bag from its only topic of poses."""

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.sources.ros.bag import Bag, Message
from sigmasplat.plugins.sources.ros.tf import lookup_transform, transform_of
from sigmasplat.types import Matrix

POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
OWN_TOPICS = "/sigmasplat/"
"""Topics of `sigmasplat run --bag` begin like this. Their poses are estimates of an earlier run."""


def read_truth(bag: Bag, camera_frame: str, recorded_time: bool) -> Trajectory | None:
    """Return the path of the colour camera if exactly one topic holds poses, else None.

    If the messages name the moving body, the bag's static transforms convert its poses to the camera; without such a
    transform the result is None. If they name no body (PoseStamped), the poses are assumed to be the camera's.
    Estimates of an earlier run of SigmaSplat do not count. `recorded_time`: use recording times instead of header
    times. Raises SourceError on a damaged pose.
    """
    topics = [topic for topic in bag.topics_of_type(*POSE_TYPES) if not topic.name.startswith(OWN_TOPICS)]
    if len(topics) != 1 or topics[0].count < 2:
        return None
    name = topics[0].name
    entries, messages = bag.index(name)[name], list(bag.messages(name))
    body = getattr(messages[0], "child_frame_id", "").lstrip("/")
    T_body_camera = np.eye(4)
    if body and camera_frame and body != camera_frame:
        found = lookup_transform(bag, body, camera_frame, use_tf=False)
        if found is None:
            return None
        T_body_camera = found
    times_s = np.array([(e.recorded_ns if recorded_time else e.stamp_ns) / 1e9 for e in entries])
    poses = [_pose(f"{bag.path}: {name} at {t:.3f} s", m) for t, m in zip(times_s, messages, strict=True)]
    return Trajectory(times_s, np.stack([se3.orthonormalise(T @ T_body_camera) for T in poses]))


def _pose(where: str, message: Message) -> Matrix:
    if hasattr(message, "transform"):
        return transform_of(where, message.transform.translation, message.transform.rotation)
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return transform_of(where, pose.position, pose.orientation)
