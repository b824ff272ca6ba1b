"""Tracking: predict the pose, fit it to the fixed map, judge the fit, and try other guesses if it is doubtful."""

from collections.abc import Iterator
from dataclasses import dataclass, field as dataclass_field, replace

import numpy as np
from torch import Tensor

from sigmasplat.config import Config, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.frame import NO_PRIOR, PosePrior
from sigmasplat.data.readout import UNKNOWN_TIMES, SensorTimes
from sigmasplat.fit.pose import PoseFit, fit_pose_adam, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.render.view import View
from sigmasplat.tracking import pose_validation as judge
from sigmasplat.tracking.feature_image import FeatureImage, pose_by_features
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.moving.pose_pullers import has_pulled, is_scene, suspected
from sigmasplat.tracking.pose_prediction import CameraMotion, Given, PosePrediction, odometry, predict
from sigmasplat.tracking.pose_validation import TrackingStatistics
from sigmasplat.tracking.predicted_depth_fit import NOTHING_FITTED, DepthFit
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe, mapped_keyframe
from sigmasplat.tracking.recovery import has_depth
from sigmasplat.types import Matrix, ShouldStop, never, unless


@dataclass(eq=False)
class Tracker:
    """Keeps the last pose, the motion, the last image, the reference keyframe, and statistics of recent fits.

    prior: that of the last frame; lost: tracking of the last frame failed; doubtful: number of frames in a row whose
    best pose the images contradict (`_doubts`); front: what was in front of the scene in the last frame, None if
    there was nothing or the frame was lost; keyframe_front: the same for the newest keyframe; detector: of moving
    things; depth: the fit of predicted depth; started: a frame was tracked; times: of the sensor.
    """

    config: TrackingConfig
    extractor: Extractor | None = None
    previous: Matrix = dataclass_field(default_factory=lambda: np.eye(4))
    motion: CameraMotion = dataclass_field(default_factory=CameraMotion)
    last_image: Pyramid | None = None
    keyframe: Reference | None = None
    keyframe_features: FeatureImage | None = None
    keyframe_front: DynamicMask | None = None
    front: DynamicMask | None = None
    detector: DynamicDetector = dataclass_field(default_factory=DynamicDetector)
    depth: DepthFit = NOTHING_FITTED
    agreements: list[float] = dataclass_field(default_factory=list)
    losses: list[float] = dataclass_field(default_factory=list)
    statistics: TrackingStatistics = dataclass_field(default_factory=TrackingStatistics)
    prior: PosePrior = NO_PRIOR
    lost: bool = False
    doubtful: int = 0
    started: bool = False
    times: SensorTimes = UNKNOWN_TIMES

    @staticmethod
    def of(config: Config, extractor: Extractor | None) -> "Tracker":
        """Return the tracker of a run; the extractor is left out if tracking uses no features."""
        features = extractor if config.tracking.features else None
        detector = DynamicDetector(config.moving, config.render.scene_scale)
        return Tracker(config.tracking, features, detector=detector)

    def start(self, seen: PreparedFrame) -> None:
        """Fix the gauge: the first camera is the world."""
        self.last_image, self.prior = seen.live, seen.frame.prior
        self.motion = CameraMotion(seen.frame.timestamp_s)

    def track(self, params: Tensor, view: View, seen: PreparedFrame, should_stop: ShouldStop = never) -> PoseFit:
        """Estimate T_camera_world of a frame; `self.lost` then says whether tracking failed. A given pose is taken as
        it is, and judged by the images.

        params: rows [N, 17] of the map; should_stop: asked before each further guess; if it returns True, that guess
        and the later ones are left out. A lost frame gets the best available guess (odometry, else the last pose), and
        the motion is reset.
        """
        seen.live = seen.live.noisier(self.statistics.noise)
        seen.move(self.motion.rate(), self.times)
        given, shown = Given(params, view, self.prediction(seen), should_stop), seen.shown
        predicted = given.prediction.predicted
        if given.prediction.given:
            best = self._fit(given, shown, predicted, patience=0)
            best.T_camera_world = se3.inverse(predicted)
            self.front, self.lost, self.doubtful = None, False, 0
        else:
            best = self._estimated(given, seen, shown)
            self.lost = self._is_lost(best)
            self.doubtful = self.doubtful + 1 if self._doubts(best) else 0
        self.prior = seen.frame.prior
        if self.lost:  # poses of earlier frames do not agree with later ones
            self.front, self.detector = None, self.detector.cleared()
        best.T_camera_world = se3.orthonormalise(best.T_camera_world)
        if not self.lost:
            self._notice_rest(seen, se3.inverse(best.T_camera_world))
        self._remember(best, seen)
        return best

    def _estimated(self, given: Given, seen: PreparedFrame, shown: PreparedFrame) -> PoseFit:
        """Return the best of the fits from all guesses; shown: the frame as it is fitted first."""
        best, before = self._fit(given, shown, given.prediction.predicted), self.statistics.noise
        if self.config.method == "adam":
            return self._restarted(given, shown, best)
        if self.statistics.learns_noise(best.comparison):
            seen.live = seen.live.noisier(self.statistics.noise / before)
            shown = seen.shown
            best = self._fit(given, shown, given.prediction.predicted)
        best, shown = self._uncovered(given, seen, shown, best)
        if self._is_lost(best) and not has_depth(seen):  # a covered lens: no other guess can help
            best.T_camera_world = se3.inverse(given.prediction.last)
            return best
        if self._doubts(best):
            guesses = unless(given.should_stop, self._other_guesses(shown, given.prediction))
            best = max([best, *(self._fit(given, shown, guess) for guess in guesses)], key=self._score)
        return self._retry(given, shown, best) if self._doubts(best) else best

    def _uncovered(
        self, given: Given, seen: PreparedFrame, first: PreparedFrame, fit: PoseFit
    ) -> tuple[PoseFit, PreparedFrame]:
        """Find what is in front of the scene, and fit the pose without it; return the fit and the frame without it. If
        nothing is, or the images contradict that pose: the same fit, and the frame as it was fitted (`first`)."""
        before, self.front = self.front, None
        if fit.comparison is None or self.lost:
            return fit, first
        found = self._without_front(given, seen, first, fit, before)
        if found is None and self.detector.config.find and not given.should_stop():
            found = self._without_puller(given, seen, fit)
        return (fit, first) if found is None else found

    def _without_front(
        self, given: Given, seen: PreparedFrame, first: PreparedFrame, fit: PoseFit, before: DynamicMask | None
    ) -> tuple[PoseFit, PreparedFrame] | None:
        """Return the fit and the frame without what is in space that was free, or None; before: in front in the last
        frame. The newest keyframe loses what has left it."""
        keyframe, known = self.keyframe, before or self.keyframe_front
        if keyframe is None or fit.comparison is None:
            return None
        if not self.detector.suspects(fit.comparison, known, given.should_stop):
            return None
        # the expected pose of a fast camera is centimetres off: it is used only if something may have pulled the fit
        predicted = given.prediction.predicted
        pose = predicted if self._doubts(fit) else se3.inverse(fit.T_camera_world)
        front = self.detector.in_front(keyframe, self.keyframe_front, before, self.previous, seen, pose)
        if front is not None and known is None and is_scene(front, seen.target.depth_image.numpy()):
            front = None  # a thing comes into view gradually
        self.keyframe = self.detector.without_gone(keyframe, seen, pose)
        if front is None and self.keyframe is keyframe:
            return None
        shown = first if front is None else seen.aside(front)
        found = self._fit(given, shown, predicted)
        if self._stands(found):
            self.front = front
            return found, shown
        self.keyframe = keyframe
        return None

    def _without_puller(
        self, given: Given, seen: PreparedFrame, pulled: PoseFit
    ) -> tuple[PoseFit, PreparedFrame] | None:
        """Return the fit and the frame without the thing that moves and has pulled the pose; None if there is none."""
        for front in unless(given.should_stop, suspected(seen, pulled)):
            found = self._fit(given, shown := seen.aside(front), given.prediction.predicted)
            if self._stands(found) and has_pulled(pulled, found):
                self.front = front
                return found, shown
        return None

    def _notice_rest(self, seen: PreparedFrame, T_world_camera: Matrix) -> None:
        """Take what has come to rest for a part of the scene, and remember the frame."""
        depth_m = seen.target.depth_image.numpy()
        front = self.detector.still_moving(self.front, depth_m, T_world_camera, seen.target.camera)
        self.keyframe_front = None if self.front is not None and front is None else self.keyframe_front
        self.front, self.detector = front, self.detector.after(depth_m, T_world_camera)

    def _stands(self, fit: PoseFit) -> bool:
        return not (self._is_lost(fit) or self._doubts(fit))

    def _remember(self, fit: PoseFit, seen: PreparedFrame) -> None:
        """Keep what the next frame needs."""
        T_world_camera = se3.inverse(fit.T_camera_world)
        motion = self.motion.after(se3.inverse(self.previous) @ T_world_camera, seen.frame.timestamp_s)
        self.motion = motion.stopped() if self.lost else motion
        if not self.lost:
            self.agreements = [*self.agreements, fit.agreement * fit.overlap][-judge.RECENT :]
            self.losses = [*self.losses, fit.loss][-judge.RECENT :]
            if fit.comparison is not None:
                self.statistics.add(fit.comparison)
        self.previous = T_world_camera
        seen.move(self.motion.rate(), self.times)
        self.last_image, self.started = seen.without(self.front).live, True

    # ---- guesses ----

    def prediction(self, seen: PreparedFrame) -> PosePrediction:
        """Return where the camera of the next frame is expected; with `adam` as in the papers, whatever its time."""
        motion = self.motion.velocity if self.config.method == "adam" else self.motion.until(seen.frame.timestamp_s)
        return predict(self.previous, motion, self.prior, seen.frame.prior)

    def _fit(self, given: Given, seen: PreparedFrame, guess: Matrix, patience: int = 1) -> PoseFit:
        """Fit from an initial T_world_camera; patience: factor on the number of iterations of gradient descent; with 0,
        the pose stays as it is, and is only judged."""
        T_camera_world, c = se3.inverse(guess), self.config
        if c.method == "adam":
            config = c if self.started else c.without_motion()
            steps = patience * config.iterations
            return fit_pose_adam(given.params, given.view, seen.target, T_camera_world, config, steps)
        assert self.keyframe is not None  # the first frame of each map is one
        return fit_pose_align(self.keyframe, seen.live, T_camera_world, c, patience > 0)

    def _other_guesses(self, seen: PreparedFrame, prediction: PosePrediction) -> Iterator[Matrix]:
        """Yield T_world_camera by features of the newest keyframe, and by constant velocity alone if a gyroscope
        changed the first guess."""
        known = self.keyframe_features
        if self.extractor is not None and seen.image is not None and self.keyframe is not None and known is not None:
            found = pose_by_features(known.landmarks(self.extractor), seen.image, self.extractor, seed=0)
            if found is not None:
                yield se3.inverse(found.T_live_reference @ self.keyframe.T_camera_world)
        if prediction.measured:
            yield self.previous @ self.motion.until(seen.frame.timestamp_s)

    def _restarted(self, given: Given, seen: PreparedFrame, fit: PoseFit) -> PoseFit:
        """Descend again with twice the iterations if the first loss jumped (VarSplat §3); return the only or the second
        fit, as the papers do."""
        if not judge.jumped(fit.first_loss, self.losses, self.config.restart) or given.should_stop():
            return fit
        start = self._by_odometry(given, seen) if self.config.restart == "odometry" else None
        return self._fit(given, seen, given.prediction.predicted if start is None else start, patience=2)

    def _by_odometry(self, given: Given, seen: PreparedFrame) -> Matrix | None:
        """Return T_world_camera by aligning the last image to this one; None if that fails."""
        moved = odometry(self.last_image, seen.live, given, self.config)
        return None if moved is None else np.asarray(self.previous @ se3.inverse(moved))

    def _retry(self, given: Given, seen: PreparedFrame, fit: PoseFit) -> PoseFit:
        """Retry from odometry and from the last pose (ours); return the best fit."""
        found = None if given.should_stop() else self._by_odometry(given, seen)
        starts = [start for start in (found, given.prediction.last) if start is not None]
        fits = [fit, *(self._fit(given, seen, start, 2) for start in unless(given.should_stop, starts))]
        best = max(fits, key=self._score)
        if self._is_lost(best):
            best.T_camera_world = se3.inverse(starts[0])
        return best

    # ---- verdicts ----

    def _score(self, fit: PoseFit) -> float:
        return fit.agreement * fit.overlap if fit.comparison is None else 1.0 - judge.p_wrong(fit.comparison)

    def _is_lost(self, fit: PoseFit) -> bool:
        if fit.comparison is None:
            return judge.is_lost(fit, self.config.lost_agreement, self.config.lost_share)
        # after a lost frame the path of the camera does not support a pose
        most = judge.SURE if self.lost else judge.LOST
        return fit.comparison.common < self.config.lost_share or judge.p_wrong(fit.comparison) > most

    def _doubts(self, fit: PoseFit) -> bool:
        if fit.comparison is not None:
            return judge.p_wrong(fit.comparison) > judge.DOUBTFUL
        usual = float(np.median(self.agreements or [1.0]))
        return fit.alignment is not None and fit.agreement * fit.overlap < judge.DOUBT * usual

    # ---- keyframes ----

    def keep_keyframe(
        self, params: Tensor, view: View, seen: PreparedFrame, T_world_camera: Matrix, front: DynamicMask | None
    ) -> None:
        """Use a keyframe that was just mapped: its pose, and its image as the reference of the next frames; front: what
        was in front of the scene in it."""
        self.follow(mapped_keyframe(params, view, seen, T_world_camera, self.config, front))

    def came_from(self, previous: Matrix) -> None:
        """Take note that the frame before the last one was at another pose [4, 4] than thought."""
        if not self.lost:
            self.motion = replace(self.motion, velocity=se3.inverse(previous) @ self.previous)

    def follow(self, keyframe: TrackedKeyframe) -> None:
        """Use a keyframe as the reference of the next frames."""
        self.keyframe = keyframe.reference
        self.keyframe_features, self.keyframe_front = keyframe.image, keyframe.front

    def move_to(self, params: Tensor, view: View, keyframe: TrackedKeyframe, T_world_camera: Matrix) -> None:
        """Continue at another pose after a lost frame, with a keyframe as the reference of the next frames."""
        self.previous, self.lost = T_world_camera, False
        self.follow(keyframe.weighed(params, view, self.config))

    def continue_elsewhere(self, apart: bool) -> None:
        """Go on where the search has found the camera, or in a new map (`apart`)."""
        self.motion, self.lost = self.motion.stopped(), self.lost and not apart
        self.detector = self.detector.cleared()

    def move_by(self, T_new_old: Matrix, previous: Matrix | None = None) -> None:
        """Express the last pose and the reference in other coordinates [4, 4]; previous: the last pose there, if it is
        known without rounding."""
        self.previous = T_new_old @ self.previous if previous is None else previous
        self.keyframe = None if self.keyframe is None else self.keyframe.moved_by(T_new_old)
        self.detector = self.detector.moved_by(T_new_old)
