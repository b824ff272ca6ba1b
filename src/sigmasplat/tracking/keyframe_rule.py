"""Decide which frames become keyframes."""

import numpy as np

from sigmasplat.data import se3
from sigmasplat.types import Matrix


def is_keyframe(frames_since: int, every: int, overlap: float, overlap_below: float) -> bool:
    """Return whether to map a frame: `every` frames after the last keyframe (VarSplat §2), or when the overlap is
    low."""
    return frames_since >= every or overlap < overlap_below


def has_moved(T_keyframe_camera: Matrix, depth_m: float, most_deg: float) -> bool:
    """Return whether the image has moved by more than an angle since the last keyframe."""
    return bool(np.rad2deg(se3.angle_between(np.eye(4), T_keyframe_camera, depth_m)) > most_deg)


def is_held_back(index: int, every: int) -> bool:
    """Return whether a frame is held back from the map: the last one of each `every` frames; 0 = none."""
    return every > 0 and index % every == every - 1
