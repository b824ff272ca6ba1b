"""fit_pose: move one camera, the field fixed. By the papers' Adam through the renderer, or by aligning images."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.align import Alignment, align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import PoseMaps, agreement, tracking_gradient
from sigmasplat.model import se3
from sigmasplat.render.view import View

Matrix = NDArray[np.float64]


@dataclass(eq=False)
class PoseFit:
    """T_camera_world; agreement: share of pixels seen by both map and sensor whose depths agree; overlap: share of
    sensor readings where the map has a surface; first and last loss; iterations; alignment: what found it, or None;
    degenerate: how many directions of motion the images say nothing about (there the guess stays); exposure
    (a, b) of exp(a)·Ĉ + b."""

    T_camera_world: Matrix
    agreement: float
    overlap: float
    first_loss: float
    loss: float
    iterations: int
    alignment: Alignment | None = None
    degenerate: int = 0
    exposure: tuple[float, float] = (0.0, 0.0)

    @property
    def covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of the left twist (ρ, φ), m and rad, to the reference; None from descent."""
        return None if self.alignment is None else self.alignment.covariance


def fit_pose_adam(
    params: Tensor, view: View, target: Target, T_camera_world: Matrix, config: TrackingConfig, iterations: int
) -> PoseFit:
    """Descend L_track by Adam over a unit quaternion and a translation after the first guess; the best iterate wins.

    params [N, 17] and σ² are frozen (VarSplat §3). Ends early when a step is below `update_stop`, or when it changed
    the loss by less than `plateau_stop` of it. Raises nothing: without common pixels the guess comes back.
    """
    motion, exposure = np.array([1.0, 0, 0, 0, 0, 0, 0]), np.zeros(2)
    adam, adam_exposure = VectorAdam.of(7), VectorAdam.of(2)
    rates = np.array([config.lr_rotation] * 4 + [config.lr_translation] * 3)
    rate_exposure = np.full(2, config.lr_exposure if config.exposure else 0.0)
    best, best_T, best_exposure, first, previous = np.inf, T_camera_world, np.zeros(2), np.inf, np.inf
    steps = 0
    for steps in range(1, iterations + 1):
        T = _motion(motion) @ T_camera_world
        view.forward(params, T)
        loss, g_exposure = tracking_gradient(view, target, config, torch.as_tensor(exposure).float())
        first = loss if steps == 1 else first
        if loss < best:
            best, best_T, best_exposure = loss, T, exposure.copy()
        moved = adam.step(_motion_gradient(motion, view.backward_pose(params)), rates)
        motion += moved
        exposure += adam_exposure.step(g_exposure.double().numpy(), rate_exposure)
        if np.abs(moved).max() < config.update_stop or abs(loss - previous) < config.plateau_stop * loss:
            break
        previous = loss
    view.forward(params, best_T)
    agree, overlap = agreement(PoseMaps.of(view), target)
    T_best, (a, b) = se3.orthonormalise(best_T), best_exposure.tolist()
    return PoseFit(T_best, agree, overlap, first, best, steps, exposure=(a, b))


def _motion(quaternion_translation: NDArray[np.float64]) -> Matrix:
    """Build the 4×4 motion of (w, x, y, z, tx, ty, tz), the quaternion of any norm."""
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion(quaternion_translation[:4])
    T[:3, 3] = quaternion_translation[4:]
    return T


def _motion_gradient(quaternion_translation: NDArray[np.float64], twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn the gradient by the left twist (ρ, φ) of motion · guess into that by the motion's seven numbers.

    The motion's rotation turns the pose about the motion's translation t, so it feels g = g_φ − t × g_ρ; a quaternion q
    feels that as 2 (0, g) ⊗ q / |q|².
    """
    q, t = quaternion_translation[:4], quaternion_translation[4:]
    g = twist[3:] - np.cross(t, twist[:3])
    w, v = q[0], q[1:]
    g_q = 2.0 * np.concatenate([[-g @ v], w * g + np.cross(g, v)]) / (q @ q)
    return np.concatenate([g_q, twist[:3]])


def fit_pose_align(reference: Reference, live: Pyramid, T_camera_world: Matrix, config: TrackingConfig) -> PoseFit:
    """Align the live image to a reference by Gauss–Newton (`fit.align`), from a first guess."""
    guess = T_camera_world @ se3.inverse(reference.T_camera_world)
    found = align(
        reference.pyramid, live, guess, config.align_iterations, config.align_weight_color, config.align_stop,
        config.plateau_stop,
    )  # fmt: skip
    return PoseFit(
        found.T_live_reference @ reference.T_camera_world,
        found.agreement,
        found.overlap,
        float("nan"),
        found.cost,
        found.steps,
        alignment=found,
        degenerate=found.degenerate,
    )
