"""Sum up how far tracking may be off within a submap: what cuts submaps where tracking is weak, and weighs odometry."""

from dataclasses import dataclass, field

import numpy as np

from sigmasplat.model import se3
from sigmasplat.types import Matrix

HOP_M, HOP_RAD = 0.002, 0.002
"""What each hop adds to odometry's deviation beyond its estimated covariance, which knows noise but not bias."""
UNKNOWN = np.diag([1.0] * 6)
"""Covariance of a hop between images that have nothing in common, m² and rad²."""
BIAS = 0.02
"""Share of the way travelled and of the angle turned by which a whole submap may be bent: what is wrong with a
calibration does not average out from hop to hop. On redkitchen rotations come out 3 to 11 % short of the truth's."""


@dataclass(eq=False)
class Drift:
    """Covariance [6, 6] of the left twist (ρ, φ) of T_submap_keyframe, metres and radians: zero at the first keyframe.

    Each frame is tracked against the newest keyframe, so errors add up from keyframe to keyframe and not from frame to
    frame. First order: covariances of hops are independent and add, each carried into the submap's frame. `covariance`
    is what alignment itself says of its hops, `usual` what they are off by beside that.
    """

    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    usual: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    travelled_m: float = 0.0
    turned_rad: float = 0.0
    last: Matrix = field(default_factory=lambda: np.eye(4))

    def hop(self, T_submap_camera: Matrix, covariance: Matrix | None) -> None:
        """Add a hop to the keyframe at T_submap_camera [4, 4], `covariance` [6, 6] of T_camera_reference's left twist.

        T_reference_camera = exp(ξ)⁻¹ …: on the right of the chain, ξ is felt on the left as −Ad(T_submap_camera) ξ.
        None: nothing is known of the hop, it counts as a usual one; infinite: the images have nothing in common.
        """
        A = se3.adjoint(T_submap_camera)
        self.usual = symmetric(self.usual + A @ np.diag(np.repeat([HOP_M**2, HOP_RAD**2], 3)) @ A.T)
        if covariance is not None:
            known = covariance if np.isfinite(covariance).all() else UNKNOWN
            self.covariance = symmetric(self.covariance + A @ known @ A.T)
        moved = se3.inverse(self.last) @ T_submap_camera
        self.travelled_m += float(np.linalg.norm(moved[:3, 3]))
        self.turned_rad += se3.rotation_angle(moved[:3, :3])
        self.last = T_submap_camera.copy()

    def position_m(self, T_submap_camera: Matrix) -> float:
        """Return the accumulated tracking uncertainty: the standard deviation of the camera's position in the submap,
        T_submap_camera [4, 4]'s, metres, √ of the sum over the axes, by what alignment says of itself.

        A twist moves the position p by ρ + φ × p.
        """
        moved = np.hstack([np.eye(3), -se3.hat(T_submap_camera[:3, 3])])
        return float(np.sqrt(np.trace(moved @ self.covariance @ moved.T)))

    @property
    def information(self) -> Matrix:
        """Return what the chain says of its end [6, 6] (m, rad): inverse covariance, usual errors and `BIAS` included.

        There must have been a hop.
        """
        bent = np.repeat([(BIAS * self.travelled_m) ** 2, (BIAS * self.turned_rad) ** 2], 3)
        return symmetric(np.asarray(np.linalg.inv(self.covariance + self.usual + np.diag(bent)), np.float64))


def symmetric(matrix: Matrix) -> Matrix:
    """Return a matrix [n, n] that is symmetric up to rounding as one that is."""
    return np.asarray(0.5 * (matrix + matrix.T))
