"""Covariance of a new pose while frames arrive: that of `path_covariance`, from what is known so far."""

from dataclasses import dataclass

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.graph.closer import LoopCloser
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.tracking.drift import hop_errors
from sigmasplat.types import Matrix

FIRST_HOP = hop_errors()
"""Covariance of a frame's motion from its keyframe before any motion between keyframes was measured, m² and rad²."""


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """What the covariance of a new pose needs: of_keyframe [6, 6] of the newest keyframe's pose in the world, and hop
    [6, 6] of a frame's motion from a keyframe, both of left twists."""

    of_keyframe: Matrix
    hop: Matrix

    def of(self, T_world_camera: Matrix, hops: int) -> Matrix:
        """Return the covariance [6, 6] of position and rotation in the axes of the world, m² and rad², of a pose that
        is so many independent motions away from the keyframe."""
        A, J = se3.adjoint(T_world_camera), se3.displacement(T_world_camera)
        return np.asarray(J @ (self.of_keyframe + hops * (A @ self.hop @ A.T)) @ J.T)


NO_ERRORS = PoseErrors(np.zeros((6, 6)), FIRST_HOP)
"""At the first frame."""


@dataclass(eq=False)
class NewestCovariance:
    """Computes the errors of new poses. Those of the keyframes are computed again only after a keyframe."""

    _state: bytes = b""
    _errors: PoseErrors = NO_ERRORS

    def errors(self, atlas: Atlas, closer: LoopCloser) -> PoseErrors:
        """Return the errors for poses relative to the newest keyframe."""
        submap, keyframe = len(atlas.keyframe_poses) - 1, len(atlas.keyframe_poses.last) - 1
        counts = np.array([submap, keyframe, atlas.keyframe_poses.total, *atlas.components])
        state = counts.tobytes() + (atlas.anchors[-1] @ atlas.keyframe_poses.last[-1]).tobytes()
        if state != self._state:
            path = PathCovariance.of_keyframes(atlas, closer.valid)
            self._errors = PoseErrors(path.of_keyframe(submap, keyframe), newest_hop(atlas))
            self._state = state
        return self._errors


def newest_hop(atlas: Atlas) -> Matrix:
    """Return the covariance [6, 6] of the left twist of the newest motion between keyframes that was measured.

    It stands for that of a frame from its keyframe, which is tracked in the same way.
    """
    known = (hop for hop in reversed(atlas.hops) if np.isfinite(hop.covariance).all())
    hop: RelativePose | None = next(known, None)
    return FIRST_HOP if hop is None else np.asarray(hop.covariance + np.diag(hop.bias**2))
