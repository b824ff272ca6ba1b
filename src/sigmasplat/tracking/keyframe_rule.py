"""Decide which frames become keyframes; both clocks use these rules."""

import numpy as np

from sigmasplat.config import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.trajectory import TRACKED
from sigmasplat.fit.pose import PoseFit
from sigmasplat.tracking.frame_estimate import FrameEstimate
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.tracker import Tracker


def is_mappable(fit: PoseFit, tracker: Tracker, recovery: Recovery) -> bool:
    """Return whether the pose of the frame tracked last is certain enough to map the frame."""
    return not tracker.lost and recovery.is_steady and tracker.is_certain(fit)


def becomes_keyframe(fit: PoseFit, tracker: Tracker, since: int, config: MappingConfig, most_deg: float = 0.0) -> bool:
    """Return whether the frame tracked last becomes a keyframe, `since` frames after the last one.

    most_deg > 0: after `every` frames, the image must also have moved by more than this angle.
    """
    if tracker.detector.renews(fit.comparison, tracker.front):
        return True
    if not most_deg or tracker.keyframe is None:
        return is_keyframe(since, config.every, fit.overlap, config.overlap_below)
    depth_m = 1.0 if fit.alignment is None else fit.alignment.depth_m
    T_keyframe_camera = tracker.keyframe.T_camera_world @ se3.inverse(fit.T_camera_world)
    moved_rad = se3.angle_between(np.eye(4), T_keyframe_camera, depth_m)
    moved = since >= config.every and bool(np.rad2deg(moved_rad) > most_deg)
    return moved or fit.overlap < config.overlap_below


def is_keyframe(frames_since: int, every: int, overlap: float, overlap_below: float) -> bool:
    """Return whether to map a frame: `every` frames after the last keyframe (VarSplat §2), or when the overlap is
    low."""
    return frames_since >= every or overlap < overlap_below


def is_held_back(index: int, every: int) -> bool:
    """Return whether a frame is held back from the map: the last one of each `every` frames; 0 = none."""
    return every > 0 and index % every == every - 1


def may_validate(estimate: FrameEstimate, tracker: Tracker, recovery: Recovery) -> bool:
    """Return whether a frame may become a validation view: it is not mapped, and its pose is not doubtful."""
    tracked = estimate.state == TRACKED and not estimate.mapped
    return tracked and recovery.is_steady and not tracker.doubtful
