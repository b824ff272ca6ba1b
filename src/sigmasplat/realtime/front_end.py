"""The clock of the camera: track frames against the newest snapshot of the map, and choose keyframes.

What the two clocks hand to each other is defined here: tracked frames one way, snapshots of the map the other way. A
message is never changed after it was handed over. It holds copies of everything that its sender changes later.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.readout import UNKNOWN_TIMES, SensorTimes
from sigmasplat.data.trajectory import APART, RELOCALISED, TRACKED
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.target import Target
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.graph.path_covariance import NO_ERRORS, PoseErrors
from sigmasplat.mapping.window import ValidationViews
from sigmasplat.render.view import View
from sigmasplat.slam.results import Step, StepTimer, SubmapState, make_step
from sigmasplat.system.array_interface import Correction
from sigmasplat.tracking.keyframe_rule import becomes_keyframe, hop_alignment, is_held_back, is_mappable, may_validate
from sigmasplat.tracking.newest_frame import FrameEstimate, NewestFrame
from sigmasplat.tracking.pose_prediction import CameraMotion
from sigmasplat.tracking.predicted_depth_frames import fitted_keyframe, fitted_to_map
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe, refuse_first_without_depth
from sigmasplat.tracking.recovery import Recovery, usable
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix, ShouldStop, never

Poses = Mapping[int, Matrix]
"""T_submap_camera [4, 4] of frames, by the number of the frame."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The active map as tracking needs it, after a keyframe was mapped or the camera was found.

    frame: number of the frame that was mapped or found; poses: of this frame and of the newest keyframe, in the active
    submap; state: how the frame came into the map, "" if it was tracked; params [N, 17]: rows of the splats; keyframe:
    reference of the next frames; doubt: the probability that its place is wrong; loops: all pairs
    tried so far; searched: number of the last frame that was searched for in the whole map; seconds: of the
    work since the snapshot before; errors: of poses relative to the newest keyframe, if the system computes them;
    correction: of earlier poses since the snapshot before, if a function of the caller wants it; times: of the sensor.
    """

    frame: int
    newest: int
    poses: Poses
    state: str
    params: Tensor
    keyframe: TrackedKeyframe
    active: SubmapState
    doubt: float
    loops: Loops = field(default_factory=Loops)
    searched: int = -1
    seconds: float = 0.0
    errors: PoseErrors = NO_ERRORS
    correction: Correction | None = None
    times: SensorTimes = UNKNOWN_TIMES


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A tracked frame: its number; its step as reported; its pose T_submap_camera [4, 4] and those of the keyframes
    that it may be placed by, all in the coordinates of the tracker at that time.

    based_on: the frame of the snapshot that it was tracked with, −1 = none; offer: what the map gets if
    it is a keyframe; search: if it is lost and searched for; shown: its images if it may become a validation view;
    apart: whether a new map begins if it is not found.
    """

    number: int
    step: Step
    T_submap_camera: Matrix
    poses: Poses
    based_on: int = -1
    offer: NewestFrame | None = None
    search: PreparedFrame | None = None
    shown: Target | None = None
    apart: bool = False


NOTHING = GaussianField.empty().params


@dataclass(eq=False)
class FrontEnd:
    """Everything that changes at the rate of the camera.

    poses: T_submap_camera [4, 4] of the newest mapped keyframe and of later keyframes and searched frames, in the
    coordinates of the tracker; frames: number of frames so far; newest: number of the frame that is the
    reference of tracking; offered, refused: numbers of keyframes that were handed to the map, and that were not because
    too many waited;
    searching: number of the frame that is searched for, −1 = none; waits: numbers of the keyframes not yet mapped;
    late: the last frame, if its sensor reads late: it is handed over when the next one has shown how its camera moved.
    """

    config: Config
    tracker: Tracker
    recovery: Recovery
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
    late: tuple[NewestFrame, TrackedFrame] | None = None

    def copied(self) -> "FrontEnd":
        """Return a copy that later frames do not change."""
        tracker = replace(self.tracker, statistics=copy.deepcopy(self.tracker.statistics))
        return replace(self, tracker=tracker, recovery=copy.copy(self.recovery))

    # ---- a new snapshot ----

    def adopt(self, snapshot: Snapshot) -> None:
        """Continue with a new snapshot: express all poses in its submap, and track relative to its keyframe if no later
        frame is a keyframe."""
        before, now = self.poses[snapshot.frame], snapshot.poses[snapshot.frame]
        moved = not np.array_equal(before, now)
        if moved:
            T_new_old = now @ se3.inverse(before)
            self.tracker.move_by(T_new_old, now if snapshot.frame == self.frames - 1 else None)
            self.late = None if self.late is None else (self.late[0].moved_by(T_new_old), self.late[1])
        kept = {n: T_new_old @ T if moved else T for n, T in self.poses.items() if n > snapshot.newest}
        self.poses = kept | dict(snapshot.poses)
        if snapshot.state:
            self._found(snapshot)
        if snapshot.newest >= self.newest or snapshot.state:
            self.tracker.follow(snapshot.keyframe)
            self.newest = snapshot.newest
        # keyframes that were tracked before the camera was found are not mapped
        self.waits = () if snapshot.state else tuple(number for number in self.waits if number > snapshot.newest)
        if snapshot.searched >= self.searching:
            self.searching = -1
        self.snapshot = snapshot
        self.tracker.times = snapshot.times

    def _found(self, snapshot: Snapshot) -> None:
        """Continue where the camera was found, or in a new map."""
        self.recovery.found()
        self.found = snapshot.state
        self.tracker.continue_elsewhere(apart=snapshot.state == APART)

    def covariance(self, step: Step) -> Matrix:
        """Return the covariance [6, 6] of the newest step's pose, as `Slam.covariance`. Keyframes that are not mapped
        yet each add one motion."""
        s = self.snapshot
        if s is None:  # then the first frame waits too, whose pose is known
            return NO_ERRORS.of(step.T_world_camera, len(self.waits) - step.is_keyframe)
        return s.errors.of(step.T_world_camera, len(self.waits) + (not step.is_keyframe))

    # ---- a frame ----

    def track(
        self, seen: PreparedFrame, view: View, timer: StepTimer, should_stop: ShouldStop = never
    ) -> tuple[Step, list[TrackedFrame]]:
        """Track a frame, and decide whether it becomes a keyframe; return its step, and the frames to hand over;
        should_stop: as in `Tracker.track`."""
        number, search, given = self.frames, None, list[TrackedFrame]()
        if number == 0:
            estimate, followed = self._begin(seen), True
        else:
            with timer.stage("track"), timer.kernels_of(view, "track_kernels"):
                splats = NOTHING if self.snapshot is None else self.snapshot.params
                seen = fitted_to_map(self.tracker, splats, view, seen)
                fit = self.tracker.track(splats, view, seen, should_stop)
                given += self.settled(self.tracker.motion, view)
            estimate = FrameEstimate.of(fit, self.tracker.lost)
            self.recovery.count(self.tracker.lost, self.tracker.doubtful > 0, seen)
            held_back = is_held_back(number, self.config.input.hold_every)
            followed = not held_back and self._becomes_keyframe(fit, seen, estimate)
            search = None if held_back else self._search(seen)
        found = NewestFrame.of(seen, estimate, self.tracker, number)
        offer = self._follow(found, view) if followed else None
        if search is not None or estimate.mapped:
            self.poses = {**self.poses, number: estimate.T_submap_camera}
        step = self._step(seen, estimate, timer, view)
        self.frames += 1
        based_on = -1 if self.snapshot is None else self.snapshot.frame
        shown = self._validation_view(number, seen, view, estimate)
        T, apart = estimate.T_submap_camera, self.recovery.gives_up
        newest = TrackedFrame(number, step, T, self.poses, based_on, offer, search, shown, apart)
        if not found.reads_late:
            return step, [*given, newest]
        self.late = found, newest
        return step, given

    def settled(self, after: CameraMotion, view: View) -> list[TrackedFrame]:
        """Return the frame that waits, if there is one, fitted again with its known motion; after: that since."""
        if self.late is None:
            return []
        (late, frame), self.late = self.late, None
        found = late.settled(after, self.tracker.times, self.config.tracking)
        if late.number == self.newest:  # until it is mapped, its motion is known at least
            self.tracker.follow(replace(found, T_world_camera=late.T_world_camera).followed)
        else:
            self.tracker.came_from(found.T_world_camera)
        T = frame.T_submap_camera @ se3.inverse(late.T_world_camera) @ found.T_world_camera
        offer = _offered(replace(found, seen=found.seen.at_once(view))) if found.mapped else None
        return [replace(frame, T_submap_camera=T, offer=offer)]

    def _begin(self, seen: PreparedFrame) -> FrameEstimate:
        """Start at the first frame, whose camera is the world until the map says otherwise."""
        refuse_first_without_depth(seen.frame, self.config)
        self.tracker.start(seen)
        self.offered, self.waits = 1, (0,)
        return FrameEstimate(np.eye(4), TRACKED, mapped=True)

    def _follow(self, found: NewestFrame, view: View) -> NewestFrame | None:
        """Track the next frames relative to a keyframe, before the map has weights for its pixels; return what the map
        gets, unless the keyframe waits."""
        if not found.reads_late:
            splats = NOTHING if self.snapshot is None else self.snapshot.params
            connected = found.connected and not self.found
            T = found.T_world_camera
            found = replace(found, seen=fitted_keyframe(self.tracker, splats, view, found.seen, T, connected))
        self.tracker.follow(found.followed)
        self.newest = found.number
        return _offered(found) if found.mapped and not found.reads_late else None

    def _becomes_keyframe(self, fit: PoseFit, seen: PreparedFrame, estimate: FrameEstimate) -> bool:
        """Return whether the frame becomes the reference of the next frames; `estimate.mapped` then says whether it is
        handed to the map."""
        since, least_deg = self.frames - self.newest, self.config.realtime.keyframe_deg
        if not is_mappable(self.tracker, self.recovery) or not becomes_keyframe(
            fit, self.tracker, since, self.config.mapping, least_deg
        ):
            return False
        estimate.alignment = hop_alignment(fit, seen.live, self.tracker)
        if len(self.waits) < self.config.realtime.waiting_most:
            estimate.mapped, self.offered, self.waits = True, self.offered + 1, (*self.waits, self.frames)
        else:
            self.refused += 1
        return True

    def _search(self, seen: PreparedFrame) -> PreparedFrame | None:
        """Return the frame to be searched for in the whole map, if it is lost and no other is searched."""
        may = self.config.recovery.relocalise or self.recovery.gives_up
        wanted = self.tracker.lost and may and usable(seen)
        if self.searching >= 0 or not wanted:
            return None
        self.searching = self.frames
        return seen.separate()

    def _validation_view(self, number: int, seen: PreparedFrame, view: View, estimate: FrameEstimate) -> Target | None:
        """Return the images of a frame that may become a validation view."""
        full = len(self.waits) >= self.config.realtime.waiting_most
        if full or not may_validate(estimate, self.tracker, self.recovery):
            return None
        views = ValidationViews(self.config.uncertainty.probes, self.config.mapping.every)
        wanted = not is_held_back(number, self.config.input.hold_every)
        kept = wanted and views.wants(self.offered - 1, number - self.newest)
        return seen.at_once(view, photo=False).target if kept else None

    def _step(self, seen: PreparedFrame, estimate: FrameEstimate, timer: StepTimer, view: View) -> Step:
        if estimate.state == TRACKED and self.found:
            estimate.state, self.found = (RELOCALISED if self.found == RELOCALISED else TRACKED), ""
        active, loops = SubmapState(), tuple[Loop, ...]()
        if self.snapshot is not None:
            active, loops = self.snapshot.active, tuple(self.snapshot.loops[self.loops :])
            estimate.doubt = self.snapshot.doubt
        self.loops += len(loops)
        seconds, waiting = timer.stop(view), len(self.waits)
        return make_step(seen, estimate, active, self.tracker, loops, seconds, waiting)


def _offered(found: NewestFrame) -> NewestFrame:
    """Return what the map gets of a keyframe: images that tracking does not change."""
    return replace(found, seen=found.seen.without(found.front).separate())
