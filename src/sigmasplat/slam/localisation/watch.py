"""Watch for what moves relative to the newest keyframe: what came in front of it, and what has left its place."""

from dataclasses import dataclass, field, replace

from sigmasplat.config import MovingConfig
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.references import Reference
from sigmasplat.model import se3
from sigmasplat.slam.localisation.foreground import Earlier, Foreground, foreground
from sigmasplat.slam.localisation.memory import Memory
from sigmasplat.slam.localisation.rest import Rest, begun
from sigmasplat.slam.localisation.sight import Sight
from sigmasplat.types import Matrix

FRONT = 0.03
"""What is in front is looked for if at least this share of the compared points is nearer than the reference."""


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


@dataclass(frozen=True, eq=False)
class Watch:
    """What is known of moving things between two frames: what recent frames saw, and how long the thing in front has
    stayed in its place (None: nothing is in front). Without `config.find` nothing is remembered."""

    config: MovingConfig = field(default_factory=MovingConfig)
    memory: Memory = field(default_factory=Memory)
    rest: Rest | None = None

    def suspects(self, found: Comparison, known: bool) -> bool:
        """Return whether something may be in front of the scene, or may have left its place in it; known: something was
        in front in the last frame or in the newest keyframe."""
        return known or found.front >= FRONT or (self.config.find and found.behind >= FRONT)

    def slow(self, seen: Sight, T_world_camera: Matrix) -> Foreground | None:
        """Find what moves too slowly to show against the newest keyframe."""
        if not self.config.find:
            return None
        target, most = seen.target, self.config.still_frames
        return self.memory.in_front(target.depth_image.numpy(), T_world_camera, target.camera, most)

    def after(self, seen: Sight, front: Foreground | None, T_world_camera: Matrix) -> "Watch":
        """Return what is known after a frame that is not lost."""
        if not self.config.find:
            return self
        depth_m, camera, rest = seen.target.depth_image.numpy(), seen.target.camera, None
        if front is not None:
            rest = begun(front, depth_m, T_world_camera)
            rest = rest if self.rest is None else self.rest.seen(front, depth_m, T_world_camera, camera)
        return replace(self, memory=self.memory.after(depth_m, front, T_world_camera), rest=rest)

    @property
    def has_rest(self) -> bool:
        """Return whether what is in front has stayed in its place for so long that it is part of the scene again."""
        return self.rest is not None and 0 < self.config.still_frames <= self.rest.frames

    def moved_by(self, T_new_old: Matrix) -> "Watch":
        """Return the same in other coordinates [4, 4]."""
        return replace(self, memory=self.memory.moved_by(T_new_old), rest=self.rest and self.rest.moved_by(T_new_old))

    def cleared(self) -> "Watch":
        """Return the watch with nothing remembered."""
        return Watch(self.config)
