"""SLAM: track every frame, map keyframes, cut submaps, close loops. `MainLoop.step` follows the papers' overviews."""

from dataclasses import replace

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.relative_pose import UNKNOWN_HOP, RelativePose
from sigmasplat.data.trajectory import APART, RELOCALISED, TRACKED
from sigmasplat.slam.mapping_backend import SLICES_PER_FRAME, MappingBackend
from sigmasplat.slam.results import Step, StepTimer, make_step
from sigmasplat.tracking.keyframe_rule import becomes_keyframe, hop_alignment, is_held_back, is_mappable, may_validate
from sigmasplat.tracking.newest_frame import FrameEstimate, NewestFrame
from sigmasplat.tracking.pose_prediction import CameraMotion
from sigmasplat.tracking.predicted_depth_frames import fitted_keyframe, fitted_to_map
from sigmasplat.tracking.prepared_frame import PreparedFrame, refuse_first_without_depth
from sigmasplat.tracking.recovery import usable
from sigmasplat.tracking.relocaliser import Relocation
from sigmasplat.types import Matrix, completed


class MainLoop(MappingBackend):
    """Simultaneous localisation and mapping, frame by frame. No part of this class reads ground truth."""

    late: NewestFrame | None = None

    def step(self, frame: Frame) -> Step:
        """Process one frame, as `Slam.step` describes."""
        self._timer, tried = StepTimer(), len(self.closer.loops)
        seen = self._prepared(frame)
        estimate = self._locate(seen) if self.steps else self._begin(seen)
        estimate.doubt = self.confidence.newest
        found = NewestFrame.of(seen, estimate, self.tracker, len(self.steps))
        self.late = found if found.reads_late else None
        if not estimate.mapped:
            self._offer_validation_view(seen, estimate)
            completed(self.refining(self.mapper.pending_now))
            with self._timer.stage("loops"):
                completed(self.closing(SLICES_PER_FRAME))
        elif self.late is None or not self.steps:
            estimate.T_submap_camera = self._map(found)
            self.tracker.previous, self.tracker.lost = estimate.T_submap_camera, False
        else:
            self.tracker.follow(found.followed)
        self.atlas.place_frame(estimate.T_submap_camera)
        loops, seconds = self.closer.loops[tried:], self._timer.stop(self.view)
        self.steps.append(make_step(seen, estimate, self.active_submap(), self.tracker, loops, seconds))
        return self.steps[-1]

    def _prepared(self, frame: Frame) -> PreparedFrame:
        """Resize a frame to working size and prepare it for the fits."""
        with self._timer.stage("prepare"):
            view = self.view_for(frame)
            self._timer.start_kernels(view)
            seen = self.observed(frame, view, self.extractor)
        return fitted_to_map(self.tracker, self.mapper.field.params, view, seen) if self.steps else seen

    def settle_late(self, after: CameraMotion) -> Matrix:
        """Fit the last frame again, if its sensor reads late, now that its motion is known; map it if it is a keyframe.
        Returns how the coordinates of tracking change, T_new_old [4, 4]; after: the motion since."""
        if self.late is None:
            return np.eye(4)
        late, T_tracked, self.late = self.late, self.late.T_world_camera, None
        with self._timer.stage("track"):
            late = late.settled(after, self.tracker.times, self.config.tracking)
        if not late.number:
            self._read_first_at_once(late)
            return np.eye(4)
        if late.mapped:
            self.tracker.move_by(late.T_world_camera @ se3.inverse(T_tracked))
            late = replace(late, T_world_camera=self._map(late))
        else:
            self.tracker.came_from(late.T_world_camera)
        self.atlas.place_again(late.T_world_camera)
        return late.T_world_camera @ se3.inverse(T_tracked) if late.mapped else np.eye(4)

    def _read_first_at_once(self, first: NewestFrame) -> None:
        """Rewrite the first frame, which was mapped before it was known how its camera moved."""
        seen, keyframe = first.seen.at_once(self.view), self.mapper.keyframes[-1]
        keyframe.target, keyframe.photo = seen.target, seen.photo(self.config)
        self.images.kept.clear()
        self.tracker.keep_keyframe(self.mapper.field.params, self.view, seen, first.T_world_camera, first.front)

    def _map(self, found: NewestFrame) -> Matrix:
        """Map a keyframe, as if it was read at once and without what moves in front, in the exposure of the map; cut
        the submap if a rule ends it here; look for the place in other components. Return its pose."""
        view, tracker, number = self.view, self.tracker, found.number
        seen, T = found.seen.at_once(view), found.T_world_camera
        seen = fitted_keyframe(tracker, self.mapper.field.params, view, seen, T, found.connected).without(found.front)
        if self.config.tracking.exposure and self.config.mapping.colors == "code":
            seen = seen.without_exposure(found.exposure)
        errors = found.alignment, found.wrong, found.reference
        hop = self.hop_to(se3.inverse(T), *errors) if found.connected else UNKNOWN_HOP
        T = self._mapped(seen, found, T, hop)
        if self.submap_ends(number, T):
            completed(self.cut(T))
            tracker.move_by(se3.inverse(T))
            T = self._mapped(seen, found, np.eye(4))  # the next submap begins with the same keyframe
        completed(self.seek_component(seen, T))
        return T

    def _mapped(
        self, seen: PreparedFrame, found: NewestFrame, T_tracked: Matrix, hop: RelativePose = UNKNOWN_HOP
    ) -> Matrix:
        """Map a keyframe at the pose where it was tracked, and track the next frames relative to it; return its pose,
        which mapping may have moved."""
        T_submap_camera = completed(self.map_keyframe(seen, found.number, T_tracked, hop))
        self.tracker.times = self.graph.times
        self.tracker.move_by(T_submap_camera @ se3.inverse(T_tracked))
        seen.live = seen.live.read(self.graph.times.read(seen.reading))  # if it has just shown the times
        self.tracker.keep_keyframe(self.mapper.field.params, self.view, seen, T_submap_camera, found.front)
        return T_submap_camera

    def _begin(self, seen: PreparedFrame) -> FrameEstimate:
        """Start the first submap at the first frame. Its camera is the world, unless there are earlier submaps: then
        it is connected to the place where it is found, or begins a new component."""
        refuse_first_without_depth(seen.frame, self.config)
        self.tracker.start(seen)
        place = self.begin_first(seen)
        if place is None:
            return FrameEstimate(np.eye(4), TRACKED, mapped=True)
        return FrameEstimate(np.eye(4), RELOCALISED, mapped=True, comparison=place.comparison, inliers=place.inliers)

    def _locate(self, seen: PreparedFrame) -> FrameEstimate:
        """Track a frame; if it is lost, search the whole map for it; if that fails too often, begin a new map."""
        with self._timer.stage("track"), self._timer.kernels_of(self.view, "track_kernels"):
            fit = self.tracker.track(self.mapper.field.params, self.view, seen)
        if self.late is not None:
            fit.T_camera_world = fit.T_camera_world @ se3.inverse(self.settle_late(self.tracker.motion))
        lost, held_back = self.tracker.lost, is_held_back(len(self.steps), self.config.input.hold_every)
        self.recovery.count(lost, self.tracker.doubtful > 0, seen)
        estimate = FrameEstimate.of(fit, lost)
        if not lost:
            since = len(self.steps) - self.mapper.keyframes[-1].index
            mappable = not held_back and is_mappable(self.tracker, self.recovery)
            estimate.mapped = mappable and becomes_keyframe(fit, self.tracker, since, self.config.mapping)
            if estimate.mapped:
                estimate.alignment = hop_alignment(fit, seen.live, self.tracker)
                if self.cuts:
                    estimate.drift_m = self.add_drift(estimate.T_submap_camera, estimate.alignment)
        elif held_back:
            return estimate  # a search for the camera could make a keyframe of this frame
        elif (place := self.relocalise(seen)) is not None:
            self._go_to(place, estimate)
        elif self.recovery.gives_up and usable(seen):
            self._begin_apart(estimate)
        return estimate

    def _offer_validation_view(self, seen: PreparedFrame, estimate: FrameEstimate) -> None:
        """Offer a frame as a validation view if it was tracked without doubt and is not held back."""
        index, newest, last = len(self.steps), self.mapper.keyframes[-1], len(self.mapper.keyframes) - 1
        since, held_back = index - newest.index, is_held_back(index, self.config.input.hold_every)
        wanted = not held_back and self.validation_views.wants(last, since)
        if wanted and may_validate(estimate, self.tracker, self.recovery):
            T_keyframe_camera = se3.inverse(newest.T_world_camera) @ estimate.T_submap_camera
            shown = seen.at_once(self.view, photo=False).target
            self.validation_views.offer(index, last, since, T_keyframe_camera, shown)

    # ---- lost and found ----

    def _go_to(self, place: Relocation, estimate: FrameEstimate) -> None:
        """Continue where the camera was found: in the active submap, or in a new one that is connected to the place."""
        estimate.state, submap = RELOCALISED, place.where[0]
        estimate.comparison, estimate.inliers = place.comparison, place.inliers
        if submap == len(self.store):
            self.found_at(place)
            estimate.T_submap_camera = place.T_submap_camera
            self.tracker.move_to(self.mapper.field.params, self.view, place.keyframe, place.T_submap_camera)
        else:
            completed(self.branch_at(place))
            estimate.T_submap_camera, estimate.mapped = np.eye(4), True
        self.recovery.found()

    def _begin_apart(self, estimate: FrameEstimate) -> None:
        """Begin a new map at the camera, whose place in the world is not known yet."""
        completed(self.begin_apart())
        self.recovery.found()
        estimate.T_submap_camera, estimate.state, estimate.mapped = np.eye(4), APART, True
