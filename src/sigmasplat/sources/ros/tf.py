"""Follow a bag's coordinate transforms, tf2_msgs/TFMessage in /tf_static and /tf, from one frame to another."""

from itertools import islice

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.sources.ros.bag import Bag, Message
from sigmasplat.types import Matrix

MAX_TF_MESSAGES = 2000
"""So many messages of /tf are looked at: transforms between the cameras of one device come again and again."""


def lookup_transform(bag: Bag, target: str, source: str, use_tf: bool = True) -> Matrix | None:
    """Return T_target_source [4, 4] along the bag's transforms, None where they do not lead from one to the other.

    `use_tf`: whether to look at the first of /tf too, for old drivers that repeat there what never changes.
    """
    edges: dict[str, dict[str, Matrix]] = {}
    for name, most in (("/tf_static", None), ("/tf", MAX_TF_MESSAGES)):
        if name not in bag.topics or not (use_tf or most is None):
            continue
        for message in islice(bag.messages(name), most):
            for link in message.transforms:
                parent, child = link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/")
                T = rigid_transform(
                    f"{bag.path}: {name}: {parent} to {child}", link.transform.translation, link.transform.rotation
                )
                edges.setdefault(parent, {}).setdefault(child, T)
                edges.setdefault(child, {}).setdefault(parent, se3.inverse(T))
        if (found := _chained(edges, target, source)) is not None:
            return found
    return None


def rigid_transform(where: str, position: Message, rotation: Message) -> Matrix:
    """Build a transform from geometry_msgs fields. Raises SourceError naming `where` unless it is finite and rigid."""
    q = np.array([rotation.w, rotation.x, rotation.y, rotation.z])
    T = np.eye(4)
    T[:3, 3] = position.x, position.y, position.z
    norm = float(np.linalg.norm(q))
    if not np.isfinite(T).all() or not abs(norm - 1.0) < 1e-2:
        raise SourceError(f"{where}: the pose is not rigid: its quaternion has length {norm:.4g}, not 1")
    T[:3, :3] = se3.rotation_from_quaternion(q)
    return T


def _chained(edges: dict[str, dict[str, Matrix]], target: str, source: str) -> Matrix | None:
    """Follow transforms from the target outwards, shortest way first."""
    reached = {target: np.eye(4)}
    queue = [target]
    for frame in queue:
        for neighbour, T in edges.get(frame, {}).items():
            if neighbour not in reached:
                reached[neighbour] = reached[frame] @ T
                queue.append(neighbour)
    return reached.get(source)
