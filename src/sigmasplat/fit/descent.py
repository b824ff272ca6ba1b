"""Minimise the tracking loss by Adam over one camera's pose and exposure, with a fixed field (VarSplat §3; CG-SLAM §6).

A pose has parameters that can be changed by addition; the gradient of a twist is converted to theirs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.fit.adam import VectorAdam, VectorAmsgrad
from sigmasplat.fit.interface import Descent
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import tracking_gradient
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class QuaternionMotion:
    """(w, x, y, z, tx, ty, tz) of the motion relative to an initial guess; the quaternion may have any norm (VarSplat).
    Like `AxisAngle`: `rotations` numbers for the rotation come first, those of the translation last."""

    guess: Matrix
    rotations = 4

    @property
    def start(self) -> Vector:
        """Return the parameters of the initial guess T_camera_world [4, 4]."""
        return np.array([1.0, 0, 0, 0, 0, 0, 0])

    def pose(self, numbers: Vector) -> Matrix:
        """Return T_camera_world of some parameters."""
        motion = np.eye(4)
        motion[:3, :3] = se3.rotation_from_quaternion(numbers[:4])
        motion[:3, 3] = numbers[4:]
        return motion @ self.guess

    def gradient(self, numbers: Vector, twist: Vector) -> Vector:
        """Convert the gradient [6] by the left twist (ρ, φ) of T_camera_world to that by the parameters.

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


def parametrisation(config: TrackingConfig, guess: Matrix) -> QuaternionMotion | AxisAngle:
    """Return the parametrisation that the settings choose, for an initial guess of T_camera_world."""
    return AxisAngle(guess) if config.parametrisation == "axis-angle" else QuaternionMotion(guess)


TrackingLoss = Callable[[Any, Target, TrackingConfig, Tensor], tuple[float, Tensor]]


def descend(
    params: Tensor, view: View, target: Target, T_camera_world: Matrix, config: TrackingConfig, iterations: int,
    tracking_loss: TrackingLoss = tracking_gradient,
) -> Descent:  # fmt: skip
    """Minimise L_track over the parameters that `parametrisation` makes of the pose; return the best iterate.

    params [N, 17] and target are on the view's device; `tracking_loss` computes the loss on that device. The descent
    stops early when `plateau_window` steps have not lowered the loss by the share `plateau_stop`. One step is not
    enough: the loss of Adam is not monotone. Without common pixels the guess is returned.
    """
    way = parametrisation(config, T_camera_world)
    numbers, exposure = way.start, np.zeros(2)
    optimiser = VectorAmsgrad if config.amsgrad else VectorAdam
    adam, adam_exposure = optimiser.of(len(numbers)), optimiser.of(2)
    rates = np.array([config.lr_rotation] * way.rotations + [config.lr_translation] * 3)
    rate_exposure = np.full(2, exposure_rate(config))
    best, best_T, best_exposure, first = np.inf, T_camera_world, np.zeros(2), np.inf
    lowered, waited, steps = np.inf, 0, 0
    for steps in range(1, iterations + 1):
        T = way.pose(numbers)
        view.forward(params, T)
        loss, g_exposure = by_texture(tracking_loss, view, target, config, torch.as_tensor(exposure).float())
        first = loss if steps == 1 else first
        blind = loss == 0.0  # no common pixels: must not replace a pose that has some
        if loss < best and not (blind and steps > 1):
            best, best_T, best_exposure = loss, T, exposure.copy()
        numbers += adam.step(way.gradient(numbers, view.backward_pose(params)), rates)
        exposure += adam_exposure.step(g_exposure.double().cpu().numpy(), rate_exposure)
        lowered, waited = (loss, 0) if loss < (1.0 - config.plateau_stop) * lowered else (lowered, waited + 1)
        if config.plateau_stop > 0 and waited >= config.plateau_window:
            break
    a, b = best_exposure.tolist()
    return Descent(best_T, (a, b), first, best, steps)


def by_texture(
    tracking_loss: TrackingLoss, view: Any, target: Target, config: TrackingConfig, exposure: Tensor
) -> tuple[float, Tensor]:
    """Compute a tracking loss whose colour part, with the median of V, uses only the pixels of `target.textured`."""
    if target.textured is None:
        return tracking_loss(view, target, config, exposure)
    share = config.weight_color
    on_color, g_exposure = tracking_loss(view, target.textured, replace(config, weight_color=1.0), exposure)
    g_color = view.g_sums.clone()
    on_depth, _ = tracking_loss(view, target, replace(config, weight_color=0.0), exposure)
    view.g_sums.mul_(1.0 - share).add_(g_color, alpha=share)
    return share * on_color + (1.0 - share) * on_depth, share * g_exposure


def exposure_rate(config: TrackingConfig) -> float:
    """Return Adam's learning rate of the exposure; 0 if exposure is not fitted."""
    return config.lr_exposure if config.exposure else 0.0
