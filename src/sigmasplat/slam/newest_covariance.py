"""Covariance of the newest frame's pose while frames arrive: that of `path_covariance`, from what is known so far."""

from dataclasses import dataclass

import numpy as np

from sigmasplat.model import se3
from sigmasplat.model.atlas import Atlas, Hop
from sigmasplat.slam.drift import HOP_M, HOP_RAD
from sigmasplat.slam.loop_closure.closer import LoopCloser
from sigmasplat.slam.path_covariance import Factors, PathCovariance
from sigmasplat.types import Matrix

FIRST_HOP = np.diag(np.repeat([HOP_M**2, HOP_RAD**2], 3))
"""Covariance of a frame's motion from its keyframe before any motion between keyframes was measured, m² and rad²."""


@dataclass(eq=False)
class NewestCovariance:
    """Computes the covariance of the newest pose. The errors of the keyframes are computed again only after a keyframe,
    the factors of `PathCovariance` only after a closed loop."""

    _keyframes: bytes = b""
    _loops: int = 0
    _factors: Factors | None = None
    _of_keyframe: Matrix | None = None

    def of(self, atlas: Atlas, closer: LoopCloser, is_keyframe: bool) -> Matrix:
        """Return the covariance [6, 6] of position and rotation of the newest frame's pose T_world_camera, in the axes
        of the world, m² and rad²."""
        submap, keyframe, T_keyframe_camera = atlas.places[-1]
        T_world_keyframe = atlas.anchors[submap] @ atlas.keyframe_poses[submap][keyframe]
        T_world_camera = T_world_keyframe @ T_keyframe_camera
        of_keyframe = self._covariance_of_keyframe(atlas, closer, T_world_keyframe)
        A, J = se3.adjoint(T_world_camera), se3.displacement(T_world_camera)
        own = np.zeros((6, 6)) if is_keyframe else A @ newest_hop(atlas) @ A.T
        return np.asarray(J @ (of_keyframe + own) @ J.T)

    def _covariance_of_keyframe(self, atlas: Atlas, closer: LoopCloser, T_world_keyframe: Matrix) -> Matrix:
        submap, keyframe, _ = atlas.places[-1]
        counts = np.array([submap, keyframe, sum(map(len, atlas.keyframe_poses)), *atlas.components])
        state = counts.tobytes() + T_world_keyframe.tobytes()
        if self._of_keyframe is None or state != self._keyframes:
            edges = closer.believed
            loops = sum(edge.loop for edge in edges)
            known = self._factors if loops == self._loops else None
            path = PathCovariance.of_keyframes(atlas, edges, known)
            self._of_keyframe = path.of_keyframe(submap, keyframe)
            self._keyframes, self._loops, self._factors = state, loops, path.factors
        return self._of_keyframe


def newest_hop(atlas: Atlas) -> Matrix:
    """Return the covariance [6, 6] of the left twist of the newest motion between keyframes that was measured.

    It stands for that of a frame from its keyframe, which is tracked in the same way.
    """
    known = (hop for hops in reversed(atlas.hops) for hop in reversed(hops) if np.isfinite(hop.covariance).all())
    hop: Hop | None = next(known, None)
    return FIRST_HOP if hop is None else np.asarray(hop.covariance + np.diag(hop.bias**2))
