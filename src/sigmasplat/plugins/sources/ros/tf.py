"""Look up the transform between two frames of a bag, from tf2_msgs/TFMessage in /tf_static and /tf."""

from itertools import islice

import numpy as np

from sigmasplat.data import se3
from sigmasplat.input.pose_files import rigid_transform
from sigmasplat.plugins.sources.ros.bag import Bag, Message
from sigmasplat.types import Matrix

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
                T = transform_of(
                    f"{bag.path}: {name}: {parent} to {child}", link.transform.translation, link.transform.rotation
                )
                edges.setdefault(parent, {}).setdefault(child, T)
                edges.setdefault(child, {}).setdefault(parent, se3.inverse(T))
        if (found := _chained(edges, target, source)) is not None:
            return found
    return None


def transform_of(where: str, position: Message, rotation: Message) -> Matrix:
    """Build a transform from geometry_msgs fields. Raises SourceError naming `where` unless it is rigid."""
    return rigid_transform(
        where, [position.x, position.y, position.z], [rotation.w, rotation.x, rotation.y, rotation.z]
    )


def _chained(edges: dict[str, dict[str, Matrix]], target: str, source: str) -> Matrix | None:
    """Return T_target_source by breadth-first search from the target, None if the source is not connected."""
    reached = {target: np.eye(4)}
    queue = [target]
    for frame in queue:
        for neighbour, T in edges.get(frame, {}).items():
            if neighbour not in reached:
                reached[neighbour] = reached[frame] @ T
                queue.append(neighbour)
    return reached.get(source)
