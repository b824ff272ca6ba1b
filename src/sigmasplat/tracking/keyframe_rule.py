"""Decide which frames become keyframes, and which end a submap; both clocks use these rules."""

import numpy as np

from sigmasplat.config import MappingConfig, SubmapConfig
from sigmasplat.data import se3
from sigmasplat.data.trajectory import TRACKED
from sigmasplat.fit.align import Alignment, align
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.tracking.newest_frame import FrameEstimate
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix

MOVED = 0.125
"""A view has changed if rotation, and translation at the mean depth, have moved it by this share of its width."""


def is_mappable(tracker: Tracker, recovery: Recovery) -> bool:
    """Return whether the frame tracked last may be mapped: it is not lost, and tracking is steady. A doubtful one may:
    its pose is more likely right than wrong, and the next frames need the map there."""
    return not tracker.lost and recovery.is_steady


def hop_alignment(fit: PoseFit, live: Pyramid, tracker: Tracker) -> Alignment | None:
    """Return the alignment to the newest keyframe that gives the covariance of a fit; None without one. For a pose
    found by gradient descent, it takes no step."""
    if fit.alignment is not None or tracker.keyframe is None:
        return fit.alignment
    T_live_keyframe = fit.T_camera_world @ se3.inverse(tracker.keyframe.T_camera_world)
    return align(tracker.keyframe.pyramid, live, T_live_keyframe, 0, tracker.config.align_weight_color)


def becomes_keyframe(fit: PoseFit, tracker: Tracker, since: int, config: MappingConfig, least_deg: float = 0.0) -> bool:
    """Return whether the frame tracked last becomes a keyframe, `since` frames after the last one; least_deg: as in
    `is_keyframe`."""
    if tracker.detector.renews(fit.comparison, tracker.front):
        return True
    moved_rad, width_rad = 0.0, np.pi
    if tracker.keyframe is not None and fit.alignment is not None:
        T_keyframe_camera = tracker.keyframe.T_camera_world @ se3.inverse(fit.T_camera_world)
        moved_rad = se3.angle_between(np.eye(4), T_keyframe_camera, fit.alignment.depth_m)
        width_rad = tracker.keyframe.pyramid.cameras[0].width_rad
    return is_keyframe(since, fit.overlap, moved_rad, width_rad, config, least_deg)


def is_keyframe(
    since: int, overlap: float, moved_rad: float, width_rad: float, config: MappingConfig, least_deg: float = 0.0
) -> bool:
    """Return whether to map a frame: when the view has changed, so that the next frames see most of their reference, or
    `config.every` frames after the last keyframe (VarSplat §2) if the image has moved by least_deg since.

    moved_rad: how far it has moved; width_rad: the angle of view.
    """
    changed = overlap < config.overlap_below or moved_rad > MOVED * width_rad
    due = since >= config.every and np.rad2deg(moved_rad) >= least_deg
    return due or bool(config.overlap_below and changed)


def is_held_back(index: int, every: int) -> bool:
    """Return whether a frame is held back from the map: the last one of each `every` frames; 0 = none."""
    return every > 0 and index % every == every - 1


def may_validate(estimate: FrameEstimate, tracker: Tracker, recovery: Recovery) -> bool:
    """Return whether a frame may become a validation view: it is not mapped, and its pose is not doubtful."""
    tracked = estimate.state == TRACKED and not estimate.mapped
    return tracked and recovery.is_steady and not tracker.doubtful


def ends_submap(T_submap_camera: Matrix, frames_since: int, uncertainty_m: float, config: SubmapConfig) -> str:
    """Return the name of the rule that ends the active submap at this keyframe, or "" if none does (VarSplat §2).

    frames_since: frames since the submap began; uncertainty_m: `Drift.position_m` of the keyframe.
    """
    c = config
    found = {
        "distance": (float(np.linalg.norm(T_submap_camera[:3, 3])), c.distance_m),
        "angle": (float(np.rad2deg(se3.rotation_angle(T_submap_camera[:3, :3]))), c.angle_deg),
        "frames": (float(frames_since), c.frames - 1e-9 if c.frames else 0.0),
        "uncertainty": (uncertainty_m, c.uncertainty_m),
    }
    return next((rule for rule, (value, limit) in found.items() if limit and value > limit), "")
