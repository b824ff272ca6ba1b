"""Define pose parameters that can be changed by addition, and convert the gradient of a twist to their gradient."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.types import Matrix

Vector = NDArray[np.float64]


class Parametrisation(Protocol):
    """A parametrisation of T_camera_world [4, 4] by a vector: first `rotations` numbers for the rotation, last three
    for the translation."""

    rotations: int

    @property
    def start(self) -> Vector:
        """Return the parameters of the initial guess."""

    def pose(self, numbers: Vector) -> Matrix:
        """Return T_camera_world of some parameters."""

    def gradient(self, numbers: Vector, twist: Vector) -> Vector:
        """Convert the gradient [6] with respect to the left twist (ρ, φ) of T_camera_world to the gradient with respect
        to the parameters."""


@dataclass(frozen=True, eq=False)
class QuaternionMotion:
    """(w, x, y, z, tx, ty, tz) of the motion relative to an initial guess; the quaternion may have any norm (VarSplat's
    code)."""

    guess: Matrix
    rotations = 4

    @property
    def start(self) -> Vector:
        return np.array([1.0, 0, 0, 0, 0, 0, 0])

    def pose(self, numbers: Vector) -> Matrix:
        motion = np.eye(4)
        motion[:3, :3] = se3.rotation_from_quaternion(numbers[:4])
        motion[:3, 3] = numbers[4:]
        return motion @ self.guess

    def gradient(self, numbers: Vector, twist: Vector) -> Vector:
        """Return the gradient with respect to the parameters.

        The motion's rotation turns the pose about the motion's translation t, so its gradient is g = g_φ − t × g_ρ.
        With respect to a quaternion q the gradient is 2 (0, g) ⊗ q / |q|².
        """
        q, t = numbers[:4], numbers[4:]
        g = twist[3:] - np.cross(t, twist[:3])
        w, v = q[0], q[1:]
        g_q = 2.0 * np.concatenate([[-g @ v], w * g + np.cross(g, v)]) / (q @ q)
        return np.concatenate([g_q, twist[:3]])


@dataclass(frozen=True, eq=False)
class AxisAngle:
    """(ω, t_wc): axis times angle of the camera-to-world rotation, radians, and the camera's position, m (CG-SLAM §6).

    Adding δ to ω rotates the camera by less than |δ|: if δ is perpendicular to ω, by 2 sin(|ω|/2)/|ω| times |δ|.
    """

    guess: Matrix
    rotations = 3

    @property
    def start(self) -> Vector:
        T_world_camera = se3.inverse(self.guess)
        return np.concatenate([se3.log_rotation(T_world_camera[:3, :3]), T_world_camera[:3, 3]])

    def pose(self, numbers: Vector) -> Matrix:
        T_world_camera = se3.exp(np.concatenate([np.zeros(3), numbers[:3]]))
        T_world_camera[:3, 3] = numbers[3:]
        return se3.inverse(T_world_camera)

    def gradient(self, numbers: Vector, twist: Vector) -> Vector:
        """Return the gradient with respect to the parameters.

        ω + δ rotates T_camera_world by φ = −Jr(ω) δ, and t_wc + δ moves it by ρ = −R_camera_world δ. So ∂L/∂ω = −Jr(ω)ᵀ
        g_φ and ∂L/∂t_wc = −R_world_camera g_ρ. Jr(ω)ᵀ is the left Jacobian Jl(ω), which `exp` applies to the ρ of its
        twist.
        """
        turned = se3.exp(np.concatenate([twist[3:], numbers[:3]]))
        return -np.concatenate([turned[:3, 3], turned[:3, :3] @ twist[:3]])


def parametrisation(config: TrackingConfig, guess: Matrix) -> Parametrisation:
    """Return the parametrisation that the settings choose, for an initial guess of T_camera_world."""
    return AxisAngle(guess) if config.parametrisation == "axis-angle" else QuaternionMotion(guess)
