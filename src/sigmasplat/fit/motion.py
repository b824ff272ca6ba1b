"""The parameters of a pose that descent changes additively: from parameters to pose, from a twist's gradient to
theirs."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import TrackingConfig
from sigmasplat.model import se3
from sigmasplat.types import Matrix

Vector = NDArray[np.float64]


class Parametrisation(Protocol):
    """T_camera_world [4, 4] as a vector whose first `rotations` numbers turn it and whose last three move it."""

    rotations: int

    @property
    def start(self) -> Vector:
        """Return the first guess's numbers."""

    def pose(self, numbers: Vector) -> Matrix:
        """Return their T_camera_world."""

    def gradient(self, numbers: Vector, twist: Vector) -> Vector:
        """Turn the gradient [6] by the left twist (ρ, φ) of T_camera_world into that by the numbers."""


@dataclass(frozen=True, eq=False)
class QuaternionMotion:
    """(w, x, y, z, tx, ty, tz) of the motion after a first guess, the quaternion of any norm (VarSplat's code)."""

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
        """The motion's rotation turns the pose about the motion's translation t, so its gradient is g = g_φ − t × g_ρ.

        By a quaternion q that is 2 (0, g) ⊗ q / |q|².
        """
        q, t = numbers[:4], numbers[4:]
        g = twist[3:] - np.cross(t, twist[:3])
        w, v = q[0], q[1:]
        g_q = 2.0 * np.concatenate([[-g @ v], w * g + np.cross(g, v)]) / (q @ q)
        return np.concatenate([g_q, twist[:3]])


@dataclass(frozen=True, eq=False)
class AxisAngle:
    """(ω, t_wc): axis times angle of the camera-to-world rotation, radians, and the camera's position, m (CG-SLAM §6).

    Adding δ to ω turns the camera by less than |δ|: by 2 sin(|ω|/2)/|ω| of it where δ is across ω.
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
        """ω + δ turns T_camera_world by φ = −Jr(ω) δ, and t_wc + δ moves it by ρ = −R_camera_world δ.

        So ∂L/∂ω = −Jr(ω)ᵀ g_φ and ∂L/∂t_wc = −R_world_camera g_ρ. Jr(ω)ᵀ is the left Jacobian Jl(ω), which `exp`
        applies to the ρ of its twist.
        """
        turned = se3.exp(np.concatenate([twist[3:], numbers[:3]]))
        return -np.concatenate([turned[:3, 3], turned[:3, :3] @ twist[:3]])


def parametrisation(config: TrackingConfig, guess: Matrix) -> Parametrisation:
    """Choose the numbers to descend on from a first guess of T_camera_world."""
    return AxisAngle(guess) if config.parametrisation == "axis-angle" else QuaternionMotion(guess)
