"""Find what moves: what came in front of the newest keyframe, and what has left its place in it; when it has come to
rest, by what recent frames saw."""

from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.config import MovingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.references import Reference
from sigmasplat.tracking.moving.dynamic_mask import (
    LEAST_REGION,
    DynamicMask,
    Earlier,
    coarse_step,
    dynamic_mask,
    enlarged,
    seen_again,
    smooth,
)
from sigmasplat.tracking.moving.free_space import CLEAR_M, Depth, labelled, widened
from sigmasplat.tracking.moving.pose_pullers import is_scene
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.types import Matrix, ShouldStop

EVERY = 5
"""Every fifth frame is remembered."""
AT_REST, KNOWN = 0.85, 0.3
"""A region is at rest if this share of it was seen at the same place before, and at least this share is known."""


@dataclass(frozen=True, eq=False)
class RememberedDepth:
    """A remembered frame: its number, its depth [H, W] m, and T_world_camera [4, 4]."""

    number: int
    depth_m: Depth
    T_world_camera: Matrix


FRONT = 0.03
"""What is in front is looked for if at least this share of the compared points is nearer than the reference."""

RENEWED = 0.7
"""A frame with something in front becomes a keyframe if it shares less than this with the newest one."""


@dataclass(frozen=True, eq=False)
class DynamicDetector:
    """What is known of moving things between two frames: the number of frames since the camera was found, and what some
    recent ones saw, the newest last; nothing without `config.find`. scene_scale: of the scene relative to a room."""

    config: MovingConfig = field(default_factory=MovingConfig)
    scene_scale: float = 1.0
    frames: int = 0
    recent: tuple[RememberedDepth, ...] = ()

    def suspects(self, found: Comparison, known: DynamicMask | None, should_stop: ShouldStop) -> bool:
        """Return whether something may be in front of the scene, or may have left its place in it; known: what was
        in front in the last frame or in the newest keyframe. If the next frame waits (`should_stop`), only what is in
        front is looked for."""
        seen_through = self.config.find and found.behind >= FRONT and not should_stop()
        return known is not None or found.front >= FRONT or seen_through

    def _earlier(self, depth_m: Depth, T_earlier_live: Matrix) -> Earlier:
        return Earlier(depth_m, T_earlier_live, CLEAR_M * self.scene_scale)

    def in_front(
        self, keyframe: Reference, keyframe_front: DynamicMask | None, last: DynamicMask | None,
        T_world_last: Matrix, seen: PreparedFrame, T_world_camera: Matrix,
    ) -> DynamicMask | None:  # fmt: skip
        """Find what is in front of the scene at a pose: in places that the newest keyframe saw to be free.

        keyframe_front, last: what was in front in the newest keyframe and in the last frame, whose pose is given.
        """
        scene_m = keyframe.depth_m if keyframe_front is None else keyframe_front.scene_m
        scene = self._earlier(scene_m, keyframe.T_camera_world @ T_world_camera)
        before = None if last is None else Earlier(last.depth_m, se3.inverse(T_world_last) @ T_world_camera)
        return dynamic_mask(scene, before, seen.target.depth_image.numpy(), seen.target.camera, self.config.find)

    def without_gone(self, keyframe: Reference, seen: PreparedFrame, T_world_camera: Matrix) -> Reference:
        """Return the newest keyframe without what has moved away since, at a pose of the live camera."""
        if not self.config.find:
            return keyframe
        depth_m, live_m = keyframe.depth_m, seen.target.depth_image.numpy()
        live = self._earlier(live_m, se3.inverse(keyframe.T_camera_world @ T_world_camera))
        gone = dynamic_mask(live, None, depth_m, seen.target.camera, whole_objects=True)
        return keyframe if gone is None or is_scene(gone, depth_m) else keyframe.without(gone.hidden)

    def renews(self, found: Comparison | None, front: DynamicMask | None) -> bool:
        """Return whether a frame with something in front becomes a keyframe: it shares too little with the newest."""
        looks = self.config.find and front is not None
        return looks and found is not None and min(found.common, found.covered) < RENEWED

    def after(self, depth_m: Depth, T_world_camera: Matrix) -> "DynamicDetector":
        """Return what is known after a frame with this depth [H, W], m, that is not lost."""
        if not self.config.find:
            return self
        new = () if self.frames % EVERY else (RememberedDepth(self.frames, depth_m, T_world_camera),)
        kept = self.config.still_frames // EVERY + 1
        return replace(self, frames=self.frames + 1, recent=(*self.recent, *new)[-kept:])

    def still_moving(
        self, front: DynamicMask | None, depth_m: Depth, T_world_camera: Matrix, camera: Camera
    ) -> DynamicMask | None:
        """Return what is in front without the things that have stayed in place for `still_frames` (0 = any): they have
        come to rest, and are part of the scene again. depth_m [H, W], T_world_camera [4, 4]: of the live image."""
        frames = self.config.still_frames
        before = [k for k, earlier in enumerate(self.recent) if self.frames - earlier.number >= frames]
        if front is None or not self.config.find or not frames or not before:
            return front
        step = coarse_step(camera)
        depth = np.where(front.depth_m > 0, depth_m, np.float32(0.0))[::step, ::step]
        regions, boxes = labelled(smooth(depth))
        count = len(boxes)
        rests = np.ones(count + 1, np.bool_)
        for earlier in self.recent[before[-1] :]:  # what comes back to an earlier place has not rested there
            scene = self._earlier(earlier.depth_m, se3.inverse(earlier.T_world_camera) @ T_world_camera)
            known, same = seen_again(scene, depth, camera, step)
            counts = [np.bincount(regions[m], minlength=count + 1) for m in (regions > 0, known, same)]
            sizes, of_known, of_same = counts
            rests &= (of_same >= AT_REST * of_known) & (of_known >= KNOWN * sizes)
        rests[0] = False
        if not rests.any():
            return front
        moving = widened((regions > 0) & ~rests[regions], 3)
        if moving.sum() < LEAST_REGION * moving.size:
            return None
        whole, hidden = enlarged(moving, depth_m, step)
        whole, hidden = whole & (front.depth_m > 0), hidden & front.hidden
        depths = np.where(whole, front.depth_m, np.float32(0.0)), np.where(hidden, front.scene_m, depth_m)
        return DynamicMask(hidden, *depths)

    def moved_by(self, T_new_old: Matrix) -> "DynamicDetector":
        """Return the same in other coordinates [4, 4]."""
        recent = tuple(replace(s, T_world_camera=T_new_old @ s.T_world_camera) for s in self.recent)
        return replace(self, recent=recent)

    def cleared(self) -> "DynamicDetector":
        """Return the detector with nothing remembered."""
        return DynamicDetector(self.config, self.scene_scale)
