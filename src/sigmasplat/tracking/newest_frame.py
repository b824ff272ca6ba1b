"""The result of localising a frame. If its sensor reads late, the frame is fitted again when the next one has shown how
its camera moved."""

from dataclasses import dataclass, replace

import numpy as np

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.readout import SensorTimes
from sigmasplat.data.trajectory import LOST, TRACKED
from sigmasplat.fit.align import Alignment, align
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.references import Reference
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.pose_prediction import CameraMotion
from sigmasplat.tracking.pose_validation import p_wrong
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix


@dataclass(eq=False)
class FrameEstimate:
    """Where a frame is: T_submap_camera [4, 4] in the active submap, its state, and whether it is to be mapped.

    fit: of tracking, None for the first frame; comparison: with the map at the pose, if it was made;
    alignment: to the newest keyframe, if it is to be mapped; inliers: matches of the relocalisation; drift_m: of the
    submap, if a rule reads it; doubt: the probability that the place of the keyframe it was fitted to is wrong.
    """

    T_submap_camera: Matrix
    state: str = TRACKED
    mapped: bool = False
    fit: PoseFit | None = None
    comparison: Comparison | None = None
    alignment: Alignment | None = None
    inliers: int | None = None
    drift_m: float | None = None
    doubt: float = 0.0

    @staticmethod
    def of(fit: PoseFit, lost: bool) -> "FrameEstimate":
        """Return the result of tracking."""
        state = LOST if lost else TRACKED
        return FrameEstimate(se3.inverse(fit.T_camera_world), state, fit=fit, comparison=fit.comparison)

    @property
    def exposure(self) -> tuple[float, float]:
        """Return the exposure (a, b) of the frame relative to the map."""
        return (0.0, 0.0) if self.fit is None else self.fit.exposure

    def logged(self) -> dict[str, float]:
        """Return the values by the names of the log; what is not known is left out."""
        fit, values = self.fit, {"doubt": self.doubt}
        if fit is not None:
            values |= {"agreement": fit.agreement, "overlap": fit.overlap, "first_loss": fit.first_loss}
            values |= {"loss": fit.loss, "iterations": float(fit.iterations)}
        if self.comparison is not None:
            values |= vars(self.comparison)
        found = {"drift_m": self.drift_m, "inliers": self.inliers}
        return values | {name: float(value) for name, value in found.items() if value is not None}


AS_GOOD = 0.99
"""A second alignment replaces the first one if its agreement × overlap is at least this share of the first one's."""


@dataclass(frozen=True, eq=False)
class NewestFrame:
    """The newest frame, as tracking found it. If its sensor reads late, it waits until the next one shows its motion.

    number: of the frame; T_world_camera [4, 4] in the coordinates of tracking; motion: that led to it; mapped: whether
    it is a keyframe; connected: whether tracking found it from the keyframes before; reads_late: whether it waits;
    reference: the keyframe that it was aligned to, None if there is none; explained: agreement × overlap of this
    alignment; alignment: only of a frame that does not wait; front: what was in front of the scene; exposure: relative
    to the map; wrong: the probability that its tracked pose is wrong.
    """

    number: int
    seen: PreparedFrame
    T_world_camera: Matrix
    motion: CameraMotion
    mapped: bool
    connected: bool
    reads_late: bool
    reference: Reference | None
    explained: float
    alignment: Alignment | None
    front: DynamicMask | None
    exposure: tuple[float, float]
    wrong: float

    @staticmethod
    def of(seen: PreparedFrame, estimate: FrameEstimate, tracker: Tracker, number: int) -> "NewestFrame":
        """Return the frame that was tracked last."""
        tracked, fit = estimate.state == TRACKED, estimate.fit
        late = tracked and tracker.times.matter(seen.frame.depth_late_s)
        return NewestFrame(
            number, seen, estimate.T_submap_camera, tracker.motion, estimate.mapped, tracked and number > 0, late,
            tracker.keyframe if number else None, 0.0 if fit is None else fit.agreement * fit.overlap,
            None if late else estimate.alignment, tracker.front, estimate.exposure,
            0.0 if estimate.comparison is None else p_wrong(estimate.comparison),
        )  # fmt: skip

    @property
    def followed(self) -> TrackedKeyframe:
        """Return the frame as a keyframe before the map has weights for its pixels."""
        seen = self.seen.without(self.front)
        return TrackedKeyframe(Reference(seen.live, se3.inverse(self.T_world_camera)), seen.image, self.front)

    def moved_by(self, T_new_old: Matrix) -> "NewestFrame":
        """Return the frame in other coordinates of tracking [4, 4]."""
        reference = None if self.reference is None else self.reference.moved_by(T_new_old)
        return replace(self, T_world_camera=T_new_old @ self.T_world_camera, reference=reference)

    def settled(self, after: CameraMotion, times: SensorTimes, config: TrackingConfig) -> "NewestFrame":
        """Return the frame with the pose that agrees with its motion before and after it."""
        self.seen.move(self.motion.rate(after), times)
        if self.reference is None:
            return self
        shown = self.seen.shown if self.front is None else self.seen.aside(self.front)
        live, T_reference = shown.live, self.reference.T_camera_world
        guess = se3.inverse(self.T_world_camera) @ se3.inverse(T_reference)
        images = self.reference.pyramid.finest(), live.finest()  # it is nearer than the coarse sizes can tell
        found = align(*images, guess, weight_color=config.align_weight_color)
        if found.agreement * found.overlap < AS_GOOD * self.explained:
            return replace(self, alignment=found)
        T_world_camera = np.asarray(se3.inverse(se3.orthonormalise(found.T_live_reference @ T_reference)))
        return replace(self, T_world_camera=T_world_camera, alignment=found)
