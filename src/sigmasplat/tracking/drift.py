"""Accumulate the covariance of tracking within a submap. It ends submaps, and weights odometry edges."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sigmasplat.data import se3
from sigmasplat.fit.align import UNKNOWN_M
from sigmasplat.types import Matrix

HOP_M, HOP_RAD = 0.002, 0.002
"""Standard deviation added per hop: the estimated covariance contains noise but no bias."""
FLOOR_M, FLOOR_RAD = 0.005, 0.003
"""Least standard deviation of a pose between two maps, or in another map: two maps of the same wall differ by about
this much."""
UNKNOWN = UNKNOWN_M**2 * np.eye(6)
"""Covariance of a hop between images without overlap, or of another pose without an estimate, m² and rad²."""
BIAS = 0.02
"""Relative systematic error of the distance travelled and the angle turned: calibration errors do not average out over
hops. On redkitchen the estimated rotations are 3 to 11 % smaller than the true ones."""


@dataclass(eq=False)
class Drift:
    """Covariance [6, 6] of the left twist (ρ, φ) of T_submap_keyframe, metres and radians: zero at the first keyframe.

    Each frame is tracked against the newest keyframe, so errors accumulate per keyframe, not per frame. First order:
    hops are independent, and their covariances add after transformation to the submap's frame. `covariance` sums the
    estimates of alignment; `usual` sums the constant errors that alignment cannot estimate. scene_scale: size of
    the scene relative to a room; constant errors in metres grow with it.
    """

    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    usual: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    travelled_m: float = 0.0
    turned_rad: float = 0.0
    last: Matrix = field(default_factory=lambda: np.eye(4))
    scene_scale: float = 1.0

    def hop(self, T_submap_camera: Matrix, covariance: Matrix | None) -> None:
        """Add a hop to the keyframe at T_submap_camera [4, 4], `covariance` [6, 6] of T_camera_reference's left twist.

        A left twist ξ of T_camera_reference equals the left twist −Ad(T_submap_camera) ξ of T_submap_camera.
        covariance None: unknown, only the constant error is added. Infinite: the images have no overlap.
        """
        A = se3.adjoint(T_submap_camera)
        self.usual = symmetric(self.usual + A @ hop_errors(self.scene_scale) @ A.T)
        if covariance is not None:
            known = covariance if np.isfinite(covariance).all() else UNKNOWN
            self.covariance = symmetric(self.covariance + A @ known @ A.T)
        moved = se3.inverse(self.last) @ T_submap_camera
        self.travelled_m += float(np.linalg.norm(moved[:3, 3]))
        self.turned_rad += se3.rotation_angle(moved[:3, :3])
        self.last = T_submap_camera.copy()

    def position_m(self, T_submap_camera: Matrix) -> float:
        """Return the accumulated tracking uncertainty: the standard deviation of the camera's position in the submap,
        metres (square root of the sum over the axes), from the estimates of alignment.

        T_submap_camera [4, 4] is the camera's pose.
        """
        moved = se3.displacement(T_submap_camera)[:3]
        return float(np.sqrt(np.trace(moved @ self.covariance @ moved.T)))

    @property
    def information(self) -> Matrix:
        """Return the information matrix [6, 6] (m, rad) of the last keyframe's pose: the inverse of all covariances,
        constant errors and `BIAS` included. At least one hop must have been added.
        """
        return symmetric(np.asarray(np.linalg.inv(self.covariance + self.unestimated), np.float64))

    @property
    def unestimated(self) -> Matrix:
        """Return the covariance [6, 6] (m², rad²) of the errors that alignment does not estimate: the constant ones and
        `BIAS`."""
        return self.usual + systematic_errors(self.travelled_m, self.turned_rad)


def drift_to(keyframe: int, T_submap_camera: Sequence[Matrix] | Matrix, scene_scale: float = 1.0) -> Matrix:
    """Return the covariance [6, 6] of the left twist (m, rad) of a keyframe's pose in its submap, without the part that
    alignment estimates; T_submap_camera [n, 4, 4]: the poses of the submap's keyframes in order."""
    drift = Drift(scene_scale=scene_scale)
    for T in T_submap_camera[1 : keyframe + 1]:
        drift.hop(T, None)
    return drift.unestimated


def hop_errors(scene_scale: float = 1.0) -> Matrix:
    """Return the constant covariance [6, 6] of a hop, m² and rad²."""
    return np.diag(np.repeat([(HOP_M * scene_scale) ** 2, HOP_RAD**2], 3))


def systematic_errors(moved_m: float, turned_rad: float) -> Matrix:
    """Return the covariance [6, 6], m² and rad², of the errors that grow with a motion (`BIAS`)."""
    return np.diag(np.repeat([(BIAS * moved_m) ** 2, (BIAS * turned_rad) ** 2], 3))


def floor(scene_scale: float = 1.0) -> Matrix:
    """Return the least covariance [6, 6] of a pose between two maps, m² and rad²."""
    return np.diag(np.repeat([(FLOOR_M * scene_scale) ** 2, FLOOR_RAD**2], 3))


def symmetric(matrix: Matrix) -> Matrix:
    """Return the symmetric part of a matrix [n, n]."""
    return np.asarray(0.5 * (matrix + matrix.T))
