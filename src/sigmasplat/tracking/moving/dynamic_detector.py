"""Find what moves relative to the newest keyframe: what came in front of it, and what has left its place."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.config import MovingConfig, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.fit.align import align_to_all
from sigmasplat.fit.compare import STEP, Comparison
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.tracking.moving.depth_history import DepthHistory
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask, Earlier, dynamic_mask
from sigmasplat.tracking.moving.pose_pullers import is_still, suspected
from sigmasplat.tracking.pose_validation import differs
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.types import Matrix, ShouldStop

FRONT = 0.03
"""What is in front is looked for if at least this share of the compared points is nearer than the reference."""

EARLIER, ENOUGH = 3, 0.4
"""If the newest keyframe and a frame with something in front share less than this share of the image, the pose is also
fitted to so many earlier keyframes."""
RENEWED = 0.7
"""A frame with something in front becomes a keyframe if it shares less than this with the newest one."""
SAME_POSE = 1e-6
"""Two keyframes whose poses differ by less than this are the same frame."""

DRAWN_EVERY, IN_VAIN = 2, 3
"""What draws the pose is looked for in every second frame, in every one if it is urgent: between keyframes, a wrong
pose does not last. After so many looks in vain, half as often."""


@dataclass(frozen=True, eq=False)
class DynamicDetector:
    """What is known of moving things between two frames: what recent frames saw, the keyframes before the newest one,
    the newest last, and how often something that draws the pose was looked for since something was in front. Without
    `config.find` nothing is remembered."""

    config: MovingConfig = field(default_factory=MovingConfig)
    history: DepthHistory = field(default_factory=DepthHistory)
    earlier: tuple[Reference, ...] = ()
    looks: int = 0

    def suspects(self, found: Comparison, known: DynamicMask | None, should_stop: ShouldStop) -> bool:
        """Return whether something may be in front of the scene, or may have left its place in it; known: what was
        in front in the last frame or in the newest keyframe. If the next frame waits (`should_stop`), only what is in
        front is looked for."""
        return (
            known is not None
            or found.front >= FRONT
            or (self.config.find and found.behind >= FRONT and not should_stop())
        )

    def in_front(
        self,
        keyframe: Reference | None,
        keyframe_front: DynamicMask | None,
        last: DynamicMask | None,
        T_world_last: Matrix,
        seen: PreparedFrame,
        T_world_camera: Matrix,
    ) -> DynamicMask | None:
        """Find what is in front of the scene at a pose: in places that the newest keyframe saw to be free.

        keyframe_front, last: what was in front in the newest keyframe and in the last frame, whose pose is given.
        """
        if keyframe is None:
            return None
        depth = keyframe.pyramid.depth[0]
        scene_m = keyframe.pyramid.kernels.to_host(depth) if keyframe_front is None else keyframe_front.scene_m
        scene, target = Earlier(scene_m, keyframe.T_camera_world @ T_world_camera), seen.target
        before = None if last is None else Earlier(last.depth_m, se3.inverse(T_world_last) @ T_world_camera)
        live_m, scale = target.depth_image.numpy(), keyframe.pyramid.scene_scale
        return dynamic_mask(scene, before, live_m, target.camera, self.config.find, scene_scale=scale)

    def without_gone(self, keyframe: Reference | None, seen: PreparedFrame, T_world_camera: Matrix) -> Reference | None:
        """Return the newest keyframe without what has moved away since, at a pose of the live camera."""
        if keyframe is None or not self.config.find:
            return keyframe
        depth_m, live_m = keyframe.pyramid.kernels.to_host(keyframe.pyramid.depth[0]), seen.target.depth_image.numpy()
        live = Earlier(live_m, se3.inverse(keyframe.T_camera_world @ T_world_camera))
        gone = dynamic_mask(live, None, depth_m, seen.target.camera, whole_objects=True)
        return keyframe if gone is None else keyframe.without(gone.hidden)

    def suspected(
        self, keyframe: Reference | None, seen: PreparedFrame, fit: PoseFit, config: TrackingConfig,
        contradicted: bool, urgent: bool,
    ) -> tuple["DynamicDetector", Iterator[DynamicMask]]:  # fmt: skip
        """Return the watch after a look, and the things in front that may have pulled a pose: those without which the
        rest agrees better, there or at another pose; if the images contradict it, all.

        Without contradiction, frames in which gray values differ are looked at by turns. urgent: something was in front
        in the last one, or gray values agree much less than usual.
        """
        if keyframe is None or fit.comparison is None:
            return self, iter(())
        every = (1 if urgent else DRAWN_EVERY) * (1 if self.looks < IN_VAIN else 2)
        if not (contradicted or (self.history.frames % every == 0 and differs(fit.comparison))):
            return self, iter(())
        return replace(self, looks=self.looks + 1), suspected(keyframe, seen, fit, config, contradicted)

    def takes_for_moving(
        self, front: DynamicMask | None, keyframe: Reference | None, seen: PreparedFrame, fit: PoseFit
    ) -> bool:
        """Return whether what is in front moves, by a fit without it: a still thing can seem to be in free space where
        poses or depth are wrong."""
        return front is None or not (self.config.find and is_still(front, keyframe, seen.live, fit))

    def fitted_to_all(
        self, keyframe: Reference | None, live: Pyramid, fit: PoseFit, config: TrackingConfig, should_stop: ShouldStop
    ) -> PoseFit:
        """Return the fit of a frame without what is in front; if the newest keyframe shows little of the rest, fitted
        to earlier keyframes too, unless the next frame waits (`should_stop`)."""
        c = None if should_stop() else fit.comparison
        if keyframe is None or c is None or not self.earlier or c.points >= ENOUGH * _compared_points(live):
            return fit
        references = [keyframe, *self.earlier]
        guesses = [fit.T_camera_world @ se3.inverse(reference.T_camera_world) for reference in references]
        moved = align_to_all(
            [reference.pyramid for reference in references], live, guesses, config.align_iterations,
            config.align_weight_color, config.align_stop,
        )  # fmt: skip
        T_camera_world = moved @ fit.T_camera_world
        return replace(fit, T_camera_world=T_camera_world, comparison=keyframe.compared(live, T_camera_world))

    def renews(self, found: Comparison | None, front: DynamicMask | None) -> bool:
        """Return whether a frame with something in front becomes a keyframe: it shares too little with the newest."""
        if not self.config.find or front is None or found is None:
            return False
        return min(found.common, found.covered) < RENEWED

    def followed(self, keyframe: Reference | None, newest: Reference) -> "DynamicDetector":
        """Return the watch when a keyframe is no longer the newest one; at a cut, the newest one is the same again."""
        same = keyframe is None or np.allclose(keyframe.T_camera_world, newest.T_camera_world, atol=SAME_POSE)
        if keyframe is None or same or not self.config.find:
            return self
        return replace(self, earlier=(*self.earlier, keyframe)[-EARLIER:])

    def slow(self, seen: PreparedFrame, T_world_camera: Matrix) -> DynamicMask | None:
        """Find what moves too slowly to show against the newest keyframe."""
        if not self.config.find:
            return None
        target, most = seen.target, self.config.still_frames
        return self.history.in_front(target.depth_image.numpy(), T_world_camera, target.camera, most)

    def after(self, seen: PreparedFrame, front: DynamicMask | None, T_world_camera: Matrix) -> "DynamicDetector":
        """Return what is known after a frame that is not lost."""
        if not self.config.find:
            return self
        depth_m, most = seen.target.depth_image.numpy(), self.config.still_frames
        history = self.history.after(depth_m, front, T_world_camera, most)
        return replace(self, history=history, looks=self.looks if front is None else 0)

    def still_moving(
        self, front: DynamicMask | None, seen: PreparedFrame, T_world_camera: Matrix
    ) -> DynamicMask | None:
        """Return what is in front without what has come to rest, which is part of the scene again."""
        if front is None or not self.config.find:
            return front
        target, frames = seen.target, self.config.still_frames
        return self.history.still_moving(front, target.depth_image.numpy(), T_world_camera, target.camera, frames)

    def moved_by(self, T_new_old: Matrix) -> "DynamicDetector":
        """Return the same in other coordinates [4, 4]."""
        earlier = tuple(reference.moved_by(T_new_old) for reference in self.earlier)
        return replace(self, history=self.history.moved_by(T_new_old), earlier=earlier)

    def cleared(self) -> "DynamicDetector":
        """Return the watch with nothing remembered."""
        return DynamicDetector(self.config)


def _compared_points(live: Pyramid) -> int:
    """Return how many pixels of an image a comparison looks at."""
    camera = live.cameras[0]
    return -(-camera.width // STEP) * -(-camera.height // STEP)
