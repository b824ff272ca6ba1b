"""The clock of the camera: track frames against the newest snapshot of the map, and choose keyframes."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.component import APART, LOST, RELOCALISED, TRACKED
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Target
from sigmasplat.graph.confidence import Confidence
from sigmasplat.graph.newest_covariance import NO_ERRORS
from sigmasplat.mapping.validation_views import ValidationViews
from sigmasplat.realtime.messages import Offer, Search, Snapshot, TrackedFrame
from sigmasplat.render.view import View
from sigmasplat.slam.step_result import Step, StepTimer
from sigmasplat.tracking.drift import Drift
from sigmasplat.tracking.fitted_depth import fitted_keyframe, fitted_to_map
from sigmasplat.tracking.frame_estimate import FrameEstimate
from sigmasplat.tracking.keyframe_rule import has_moved, is_held_back, is_keyframe
from sigmasplat.tracking.moving.dynamic_mask import share_of
from sigmasplat.tracking.pose_validation import is_questionable
from sigmasplat.tracking.prepared_frame import PreparedFrame, refuse_first_without_depth
from sigmasplat.tracking.recovery import Recovery, usable
from sigmasplat.tracking.tracked_keyframe import TrackedKeyframe
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix

NOTHING = GaussianField.empty()


@dataclass(eq=False)
class FrontEnd:
    """Everything that changes at the rate of the camera.

    poses: T_submap_camera [4, 4] of the newest mapped keyframe and of later keyframes and searched frames, in the
    coordinates of the tracker; frames: number of frames so far; newest: number of the frame that is the
    reference of tracking; offered, refused: numbers of keyframes that were handed to the map, and that were not because
    too many waited;
    searching: number of the frame that is searched for, −1 = none; waits: numbers of the keyframes not yet mapped.
    """

    config: Config
    tracker: Tracker
    recovery: Recovery
    confidence: Confidence = field(default_factory=lambda: Confidence([0.0]))
    snapshot: Snapshot | None = None
    poses: Mapping[int, Matrix] = field(default_factory=dict)
    frames: int = 0
    newest: int = 0
    offered: int = 0
    refused: int = 0
    searching: int = -1
    waits: tuple[int, ...] = ()
    found: str = ""
    loops: int = 0

    def copied(self) -> "FrontEnd":
        """Return a copy that later frames do not change."""
        tracker = replace(self.tracker, statistics=copy.deepcopy(self.tracker.statistics))
        return replace(self, tracker=tracker, recovery=copy.copy(self.recovery), confidence=copy.copy(self.confidence))

    # ---- a new snapshot ----

    def adopt(self, snapshot: Snapshot) -> None:
        """Continue with a new snapshot: express all poses in its submap, and track relative to its keyframe if no later
        frame is a keyframe."""
        before, now = self.poses[snapshot.frame], snapshot.poses[snapshot.frame]
        moved = not np.array_equal(before, now)
        if moved:
            T_new_old = now @ se3.inverse(before)
            self.tracker.move_by(T_new_old)
            if snapshot.frame == self.frames - 1:
                self.tracker.previous = now  # without rounding
        kept = {n: T_new_old @ T if moved else T for n, T in self.poses.items() if n > snapshot.newest}
        self.poses = kept | dict(snapshot.poses)
        if snapshot.state:
            self._found(snapshot)
        if snapshot.newest >= self.newest or snapshot.state:
            self.tracker.follow(snapshot.keyframe)
            self.newest = snapshot.newest
        self.waits = tuple(number for number in self.waits if number > snapshot.newest)
        if snapshot.searched >= self.searching:
            self.searching = -1
        self.confidence.spread_m, self.snapshot = [snapshot.spread_m], snapshot

    def _found(self, snapshot: Snapshot) -> None:
        """Continue where the camera was found, or in a new map."""
        self.recovery.found()
        self.found = snapshot.state
        self.tracker.velocity, self.tracker.detector = np.eye(4), self.tracker.detector.cleared()
        if snapshot.state == APART:
            self.tracker.lost = False

    def adopt_newest(self, snapshot: Snapshot) -> None:
        """Adopt a snapshot that follows others which were not adopted."""
        if snapshot.frame in self.poses:
            self.adopt(snapshot)

    def covariance(self, step: Step) -> Matrix:
        """Return the covariance [6, 6] of the newest step's pose, as `Slam.covariance`. Keyframes that are not mapped
        yet each add one motion."""
        s = self.snapshot
        if s is None:  # then the first frame waits too, whose pose is known
            return NO_ERRORS.of(step.T_world_camera, len(self.waits) - step.is_keyframe)
        return s.errors.of(step.T_world_camera, len(self.waits) + (not step.is_keyframe))

    # ---- a frame ----

    def track(
        self, seen: PreparedFrame, view: View, timer: StepTimer, should_stop: Callable[[], bool] = lambda: False
    ) -> TrackedFrame:
        """Track a frame, and decide whether it becomes a keyframe; should_stop: as in `Tracker.track`."""
        number, offer, search = self.frames, None, None
        if number == 0:
            found, offer = self._begin(seen, view)
        else:
            with timer.stage("track"), timer.kernels_of(view, "track_kernels"):
                splats = NOTHING if self.snapshot is None else self.snapshot
                seen = fitted_to_map(self.tracker, splats, view, seen)
                fit = self.tracker.track(splats, view, seen, seen.frame.prior, should_stop)
            found = FrameEstimate.of(fit, se3.inverse(fit.T_camera_world), self.tracker.lost)
            self.recovery.count(self.tracker.lost, self.tracker.doubtful > 0, seen)
            held_back = is_held_back(number, self.config.input.hold_every)
            offer = None if held_back else self._offer(fit, seen, view, found)
            search = None if held_back else self._search(fit, seen, offer)
        if offer is not None or search is not None:
            self.poses = {**self.poses, number: found.T_submap_camera}
        step = self._step(seen, found, timer, view)
        self.frames += 1
        based_on = -1 if self.snapshot is None else self.snapshot.frame
        probe = self._probe(number, seen, found)
        return TrackedFrame(number, step, found.T_submap_camera, self.poses, based_on, offer, search, probe)

    def _begin(self, seen: PreparedFrame, view: View) -> tuple[FrameEstimate, Offer]:
        """Start at the first frame, whose camera is the world until the map says otherwise."""
        refuse_first_without_depth(seen.frame, self.config)
        self.tracker.start(seen, seen.frame.prior)
        seen = fitted_keyframe(self.tracker, NOTHING, view, seen, np.eye(4), connected=False)
        self._follow(0, seen, np.eye(4))
        self.offered, self.waits = 1, (0,)
        return FrameEstimate(np.eye(4), TRACKED, mapped=True), Offer(seen.separate())

    def _offer(self, fit: PoseFit, seen: PreparedFrame, view: View, found: FrameEstimate) -> Offer | None:
        """Return the frame as a keyframe, if it becomes one; track the next frames relative to it."""
        certain = not self.tracker.lost and self.recovery.is_steady and self.tracker.is_certain(fit)
        if not certain or not self._is_keyframe(fit, found.T_submap_camera):
            return None
        alignment = self.tracker.hop(fit, seen.live)
        splats = NOTHING if self.snapshot is None else self.snapshot
        refitted = fitted_keyframe(self.tracker, splats, view, seen, found.T_submap_camera, connected=not self.found)
        shown = refitted.without(self.tracker.front)
        self._follow(self.frames, shown, found.T_submap_camera)
        if len(self.waits) >= self.config.realtime.waiting_most:
            self.refused += 1
            return None
        found.mapped, self.offered, self.waits = True, self.offered + 1, (*self.waits, self.frames)
        return Offer(shown.separate(), alignment, self.tracker.front, found.exposure)

    def _follow(self, number: int, seen: PreparedFrame, T_submap_camera: Matrix) -> None:
        """Track the next frames relative to a frame, before the map has weights for its pixels."""
        reference = Reference(seen.live, se3.inverse(T_submap_camera))
        self.tracker.follow(TrackedKeyframe(reference, seen.image, self.tracker.front))
        self.newest = number

    def _is_keyframe(self, fit: PoseFit, T_submap_camera: Matrix) -> bool:
        c, since, most_deg = self.config.mapping, self.frames - self.newest, self.config.realtime.keyframe_deg
        reference = self.tracker.keyframe
        if self.tracker.detector.renews(fit.comparison, self.tracker.front):
            return True
        if not most_deg or reference is None:
            return is_keyframe(since, c.every, fit.overlap, c.overlap_below)
        depth_m = 1.0 if fit.alignment is None else fit.alignment.depth_m
        moved = since >= c.every and has_moved(reference.T_camera_world @ T_submap_camera, depth_m, most_deg)
        return moved or fit.overlap < c.overlap_below

    def _search(self, fit: PoseFit, seen: PreparedFrame, offer: Offer | None) -> Search | None:
        """Return the frame to be searched for in the whole map, if it is lost or doubtful and no other is searched."""
        if self.searching >= 0 or offer is not None:
            return None
        searched, apart = self.config.recovery.relocalise, self.recovery.gives_up
        lost, questionable = self.tracker.lost, fit.comparison is not None and is_questionable(self.tracker.doubtful)
        if not ((lost and (searched or apart)) or (not lost and searched and questionable)) or not usable(seen):
            return None
        self.searching = self.frames
        return Search(seen.separate(), apart=apart) if lost else Search(seen.separate(), fit.comparison)

    def _probe(self, number: int, seen: PreparedFrame, found: FrameEstimate) -> Target | None:
        """Return the images of a frame that may become a probe view."""
        statistics = (
            found.state == TRACKED and not found.mapped and self.recovery.is_steady and not self.tracker.doubtful
        )
        full = len(self.waits) >= self.config.realtime.waiting_most
        if not statistics or full or is_held_back(number, self.config.input.hold_every):
            return None
        probes = ValidationViews(self.config.uncertainty.probes, self.config.mapping.every)
        return seen.target if probes.wants(self.offered - 1, number - self.newest) else None

    def _step(self, seen: PreparedFrame, found: FrameEstimate, timer: StepTimer, view: View) -> Step:
        s = self.snapshot
        drift, submap, component = (Drift(), 0, 0) if s is None else (s.drift, s.submap, s.component)
        if found.state == TRACKED and self.found:
            found.state, self.found = (RELOCALISED if self.found == RELOCALISED else TRACKED), ""
        state = APART if component and found.state != LOST else found.state
        loops = () if s is None else tuple(s.loops[self.loops :])
        self.loops += len(loops)
        in_submap_m = drift.position_m(found.T_submap_camera)
        found.tracking |= {
            "position_std_m": self.confidence.position_std_m(in_submap_m), "doubtful": float(self.tracker.doubtful),
            "usual_residual": self.tracker.statistics.residual, "waiting": float(len(self.waits)),
            "moving": share_of(self.tracker.front),
        }  # fmt: skip
        p_off = self.confidence.probability(state, found.tracking)
        anchor, splats = (np.eye(4), 0) if s is None else (s.T_world_submap, len(s.params))
        return Step(
            seen.frame.index, seen.frame.timestamp_s, anchor @ found.T_submap_camera, found.mapped, state == LOST,
            found.tracking, splats, submap, loops, timer.stop(view), state, component, p_off,
        )  # fmt: skip
