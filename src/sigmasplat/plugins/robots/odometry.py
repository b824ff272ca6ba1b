"""Odometry of a run: the sum of its tracked motions, which no correction changes, and the covariance of this sum."""

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
    """Odometry of a run that goes on: T_odom_camera [4, 4], the identity at the first frame that it is given.

    covariance [6, 6]: of the left twist (ρ, φ), m and rad, of T_odom_camera; None if it is not known. It sums the
    errors of hops between keyframes that tracking estimates: those of alignment are independent, the systematic ones
    are the same in all hops. It does not contain what is measured only at the end of a run: the disagreement between
    tracking and mapping (`graph.path_covariance`).
    """

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self.T_odom_camera = np.eye(4)
        self.covariance: Matrix | None = np.zeros((6, 6))
        self._independent, self._systematic = np.zeros((6, 6)), np.zeros((6, 6))
        self._last_hop: Matrix | None = None
        self._known = True
        self._last: int | None = None
        self._counted: int | None = None

    def step(self, moved: bool, lost: bool, is_keyframe: bool) -> Matrix:
        """Add the motion to the newest frame of the atlas; return T_odom_camera.

        moved: its `has_motion`; a lost frame adds no motion.
        """
        newest = len(self.atlas.places) - 1
        if self._counted is None:
            self._counted, self._last = len(self.atlas.hops), newest
            return self.T_odom_camera
        if not lost:
            motion = self._motion() if moved else None
            self._known &= motion is not None
            if motion is not None:
                self.T_odom_camera = se3.orthonormalise(self.T_odom_camera @ motion)
            self._last = newest
        self._add_new_hops()
        self.covariance = self._covariance(is_keyframe)
        return self.T_odom_camera

    def _motion(self) -> Matrix | None:
        """Return the motion to the newest frame from the last one that was not lost; None if they are in different
        components.

        Both poses are read now, so that changes of their keyframes by mapping are no motion.
        """
        assert self._last is not None
        atlas, (before, now) = self.atlas, (self.atlas.places[self._last], self.atlas.places[-1])
        if atlas.components[before.submap] != atlas.components[now.submap]:
            return None
        T = [atlas.odometry[s] @ atlas.keyframe_poses[s][k] @ T_keyframe for s, k, T_keyframe in (before, now)]
        return np.asarray(se3.inverse(T[0]) @ T[1])

    def _add_new_hops(self) -> None:
        assert self._counted is not None
        hops, first = self.atlas.hops, self._counted
        self._counted = len(hops)
        new = [hops[k] for k in range(first, self._counted) if not hops.begins_submap(k)]
        A = -se3.adjoint(self.T_odom_camera)
        for hop in new:
            self._known &= bool(np.isfinite(hop.covariance).all())
            self._independent = self._independent + A @ hop.covariance @ A.T
            self._systematic = self._systematic + A * hop.bias
            self._last_hop = hop.covariance + np.diag(hop.bias**2)

    def _covariance(self, is_keyframe: bool) -> Matrix | None:
        """Return the covariance of the newest frame: that of the newest keyframe, and the motion from it, which is as
        uncertain as the hop to this keyframe."""
        if not self._known or (self._last_hop is None and not is_keyframe):
            return None
        covariance = self._independent + self._systematic @ self._systematic.T
        if not is_keyframe and self._last_hop is not None:
            A = se3.adjoint(self.T_odom_camera)
            covariance = covariance + A @ self._last_hop @ A.T
        return np.asarray(covariance)
