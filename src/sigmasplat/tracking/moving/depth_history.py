"""Remember what recent frames saw, to notice what moves too slowly to show against the newest keyframe."""

from dataclasses import dataclass, replace

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.tracking.moving.dynamic_mask import (
    LEAST_REGION,
    DynamicMask,
    Earlier,
    dynamic_mask,
    enlarged,
    seen_again,
    smooth,
)
from sigmasplat.tracking.moving.free_space import Depth, labelled, widened
from sigmasplat.types import Matrix

EVERY = 5
"""Every fifth frame is remembered."""
AGES, LOOK_EVERY = (3, 6), 4
"""Every fourth frame is compared with a remembered one, at these places in turn, counted from the newest one. What was
in front in the last frame is found without it."""
COLUMNS_TESTED = 80
"""About so many columns of an image are tested."""
AT_REST, KNOWN = 0.85, 0.3
"""A region is at rest if this share of it was seen at the same place before, and at least this share is known."""


@dataclass(frozen=True, eq=False)
class RememberedDepth:
    """A remembered frame: its number, its depth [H, W] m, the same with what is behind moving things (0 = unknown), and
    T_world_camera [4, 4]."""

    number: int
    depth_m: Depth
    scene_m: Depth
    T_world_camera: Matrix


@dataclass(frozen=True, eq=False)
class DepthHistory:
    """The number of frames so far, and what some recent ones saw, the newest last."""

    frames: int = 0
    seen: tuple[RememberedDepth, ...] = ()

    def after(
        self, depth_m: Depth, front: DynamicMask | None, T_world_camera: Matrix, most_frames: int
    ) -> "DepthHistory":
        """Return the history after one more frame, of at most `most_frames`."""
        if self.frames % EVERY:
            return replace(self, frames=self.frames + 1)
        scene_m = depth_m if front is None else np.where(front.hidden, front.scene_m, depth_m)
        kept = max(AGES[-1], most_frames // EVERY + 1)
        seen = (*self.seen, RememberedDepth(self.frames, depth_m, scene_m, T_world_camera))[-kept:]
        return DepthHistory(self.frames + 1, seen)

    def moved_by(self, T_new_old: Matrix) -> "DepthHistory":
        """Return the history in other coordinates [4, 4]."""
        return replace(self, seen=tuple(replace(s, T_world_camera=T_new_old @ s.T_world_camera) for s in self.seen))

    def in_front(self, depth_m: Depth, T_world_camera: Matrix, camera: Camera, most_frames: int) -> DynamicMask | None:
        """Find what is in places that a remembered frame, at most `most_frames` old (0 = any), saw to be free; None in
        the frames that are not compared."""
        turn, rest = divmod(self.frames, LOOK_EVERY)
        if rest or not self.seen:
            return None
        earlier = self.seen[max(len(self.seen) - AGES[turn % len(AGES)], 0)]
        if most_frames and self.frames - earlier.number > most_frames:
            return None
        scene = Earlier(earlier.scene_m, se3.inverse(earlier.T_world_camera) @ T_world_camera)
        return dynamic_mask(scene, None, depth_m, camera, whole_objects=True, step=_step(camera))

    def still_moving(
        self, front: DynamicMask, depth_m: Depth, T_world_camera: Matrix, camera: Camera, frames: int
    ) -> DynamicMask | None:
        """Return what is in front without the things that have stayed in place for this number of frames (0 = any)."""
        before = [k for k, earlier in enumerate(self.seen) if self.frames - earlier.number >= frames]
        if not frames or not before:
            return front
        step = _step(camera)
        depth = np.where(front.depth_m > 0, depth_m, np.float32(0.0))[::step, ::step]
        regions, count = labelled(smooth(depth))
        rests = np.ones(count + 1, np.bool_)
        for earlier in self.seen[before[-1] :]:  # what comes back to an earlier place has not rested there
            scene = Earlier(earlier.depth_m, se3.inverse(earlier.T_world_camera) @ T_world_camera)
            known, same = seen_again(scene, depth, camera, step)
            sizes, of_known, of_same = (
                np.bincount(regions[m], minlength=count + 1) for m in (regions > 0, known, same)
            )
            rests &= (of_same >= AT_REST * of_known) & (of_known >= KNOWN * sizes)
        rests[0] = False
        if not rests.any():
            return front
        moving = widened((regions > 0) & ~rests[regions], 3)
        if moving.sum() < LEAST_REGION * moving.size:
            return None
        whole, hidden = enlarged(moving, step, depth_m)
        whole, hidden = whole & (front.depth_m > 0), hidden & front.hidden
        depths = np.where(whole, front.depth_m, np.float32(0.0)), np.where(hidden, front.scene_m, depth_m)
        return DynamicMask(hidden, *depths)


def _step(camera: Camera) -> int:
    return max(2, camera.width // COLUMNS_TESTED)


def together(a: DynamicMask | None, b: DynamicMask | None) -> DynamicMask | None:
    """Return all that is in front by one finding or the other."""
    if a is None or b is None:
        return b if a is None else a
    scene_m = np.where(a.hidden & b.hidden, np.maximum(a.scene_m, b.scene_m), np.where(b.hidden, b.scene_m, a.scene_m))
    return DynamicMask(a.hidden | b.hidden, np.maximum(a.depth_m, b.depth_m), scene_m)
