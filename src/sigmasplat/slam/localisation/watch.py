"""Watch for what moves relative to the newest keyframe: what came in front of it, and what has left its place."""

from sigmasplat.config import MovingConfig
from sigmasplat.fit.references import Reference
from sigmasplat.model import se3
from sigmasplat.slam.localisation.foreground import Earlier, Foreground, foreground
from sigmasplat.slam.localisation.rest import Rest, begun
from sigmasplat.slam.localisation.sight import Sight
from sigmasplat.types import Matrix


def in_front(
    keyframe: Reference | None,
    keyframe_front: Foreground | None,
    last: Foreground | None,
    T_last_live: Matrix,
    seen: Sight,
    T_world_camera: Matrix,
    whole_objects: bool,
) -> Foreground | None:
    """Find what is in front of the scene at a pose: in places that the newest keyframe saw to be free.

    keyframe_front, last: what was in front in the newest keyframe and in the last frame.
    """
    if keyframe is None:
        return None
    depth = keyframe.pyramid.depth[0]
    scene_m = keyframe.pyramid.kernels.to_host(depth) if keyframe_front is None else keyframe_front.scene_m
    scene = Earlier(scene_m, keyframe.T_camera_world @ T_world_camera)
    before = None if last is None else Earlier(last.depth_m, T_last_live)
    return foreground(scene, before, seen.target.depth_image.numpy(), seen.target.camera, whole_objects)


def without_gone(keyframe: Reference, seen: Sight, T_world_camera: Matrix) -> Reference:
    """Return the newest keyframe without what has moved away since, at a pose of the live camera."""
    depth_m = keyframe.pyramid.kernels.to_host(keyframe.pyramid.depth[0])
    live = Earlier(seen.target.depth_image.numpy(), se3.inverse(keyframe.T_camera_world @ T_world_camera))
    gone = foreground(live, None, depth_m, seen.target.camera, whole_objects=True)
    return keyframe if gone is None else keyframe.without(gone.hidden)


def resting(rest: Rest | None, front: Foreground, seen: Sight, T_world_camera: Matrix) -> Rest:
    """Return how long what is in front has stayed in its place, with this frame."""
    depth_m, camera = seen.target.depth_image.numpy(), seen.target.camera
    if rest is None:
        return begun(front, depth_m, T_world_camera)
    return rest.seen(front, depth_m, T_world_camera, camera)


def is_part_of_scene(rest: Rest, config: MovingConfig) -> bool:
    """Return whether something has stayed in its place for so long that it is part of the scene again."""
    return 0 < config.still_frames <= rest.frames
