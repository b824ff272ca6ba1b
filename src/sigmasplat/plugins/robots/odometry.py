"""Odometry of a run: the sum of its tracked motions, which no correction changes."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import LOST, RELOCALISED, Atlas, Matrix, se3

FOUND_BY_FEATURES = "inliers"
"""A step has this value if relocalisation decided its pose."""


def has_motion(state: str, tracking: Mapping[str, float]) -> bool:
    """Return whether tracking measured the motion to a frame from an earlier one, given the values of its step.

    A lost frame has only a guess, and a relocalised one was found without an earlier frame. A frame that is tracked
    again after lost ones has a motion: it is tracked from the same keyframe as the frames before them.
    """
    return state not in (LOST, RELOCALISED) and FOUND_BY_FEATURES not in tracking


def odometry_poses(
    T_chain_camera: Matrix, moved: Sequence[bool], lost: Sequence[bool], components: Sequence[int]
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Return T_odom_camera [F, 4, 4] of a finished path, the identity at the first frame, and whether all motions up to
    each frame were tracked [F].

    T_chain_camera [F, 4, 4]: poses without corrections by loops; moved [F]: `has_motion` of each frame; lost [F];
    components [F]. Motion that was not tracked is left out. A lost frame stays at the pose of the frame before.
    """
    poses, last = [np.eye(4)] if len(T_chain_camera) else [], 0
    tracked = np.ones(len(T_chain_camera), np.bool_)
    for i in range(1, len(T_chain_camera)):
        tracked[i] = lost[i] or (moved[i] and components[i] == components[last])
        pose = poses[-1]
        if tracked[i] and not lost[i]:
            pose = se3.orthonormalise(pose @ se3.inverse(T_chain_camera[last]) @ T_chain_camera[i])
        poses.append(pose)
        last = last if lost[i] else i
    return np.array(poses).reshape(-1, 4, 4), np.logical_and.accumulate(tracked)


class LiveOdometry:
    """Odometry of a run that goes on: T_odom_camera [4, 4], the identity at the first frame that it is given."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self.T_odom_camera = np.eye(4)
        self._last: int | None = None

    def step(self, moved: bool, lost: bool) -> Matrix:
        """Add the motion to the newest frame of the atlas; return T_odom_camera.

        moved: its `has_motion`; a lost frame adds no motion.
        """
        newest = len(self.atlas.places) - 1
        if self._last is not None and moved and not lost:
            self.T_odom_camera = se3.orthonormalise(self.T_odom_camera @ self._motion(self._last))
        self._last = newest if self._last is None or not lost else self._last
        return self.T_odom_camera

    def _motion(self, last: int) -> Matrix:
        """Return the motion to the newest frame from the last one that was not lost; none if they are in different
        components.

        Both poses are read now, so that changes of their keyframes by mapping are no motion.
        """
        atlas, (before, now) = self.atlas, (self.atlas.places[last], self.atlas.places[-1])
        if atlas.components[before.submap] != atlas.components[now.submap]:
            return np.eye(4)
        T = [atlas.odometry[s] @ atlas.keyframe_poses[s][k] @ T_keyframe for s, k, T_keyframe in (before, now)]
        return np.asarray(se3.inverse(T[0]) @ T[1])
