"""fit_pose: move one camera, the field fixed. By the papers' Adam through the renderer, or by aligning images."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.align import Alignment, align
from sigmasplat.fit.motion import parametrisation
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
    """Descend L_track by Adam over the numbers that `parametrisation` makes of the pose; the best iterate wins.

    params [N, 17] and σ² are frozen (VarSplat §3). Ends early when a step is below `update_stop`, or when it changed
    the loss by less than `plateau_stop` of it. Raises nothing: without common pixels the guess comes back.
    """
    params, target = params.to(view.sums.device), target.on(view.sums.device)
    way = parametrisation(config, T_camera_world)
    numbers, exposure = way.start, np.zeros(2)
    adam, adam_exposure = VectorAdam.of(len(numbers)), VectorAdam.of(2)
    rates = np.array([config.lr_rotation] * way.rotations + [config.lr_translation] * 3)
    rate_exposure = np.full(2, config.lr_exposure if config.exposure else 0.0)
    best, best_T, best_exposure, first, previous = np.inf, T_camera_world, np.zeros(2), np.inf, np.inf
    steps = 0
    for steps in range(1, iterations + 1):
        T = way.pose(numbers)
        view.forward(params, T)
        loss, g_exposure = tracking_gradient(view, target, config, torch.as_tensor(exposure).float())
        first = loss if steps == 1 else first
        blind = loss == 0.0  # where no pixel counts: that may not win over one where some do
        if loss < best and not (blind and steps > 1):
            best, best_T, best_exposure = loss, T, exposure.copy()
        moved = adam.step(way.gradient(numbers, view.backward_pose(params)), rates)
        numbers += moved
        exposure += adam_exposure.step(g_exposure.double().cpu().numpy(), rate_exposure)
        if np.abs(moved).max() < config.update_stop or abs(loss - previous) < config.plateau_stop * loss:
            break
        previous = loss
    view.forward(params, best_T)
    agree, overlap = agreement(PoseMaps.of(view), target)
    T_best, (a, b) = se3.orthonormalise(best_T), best_exposure.tolist()
    return PoseFit(T_best, agree, overlap, first, best, steps, exposure=(a, b))


def fit_pose_align(reference: Reference, live: Pyramid, T_camera_world: Matrix, config: TrackingConfig) -> PoseFit:
    """Align the live image, a gray and depth (m) pyramid, to a reference by Gauss–Newton (`fit.align`), from a guess.

    T_camera_world [4, 4]: the guess for the live camera. The fit's `loss` is the cost it ended with, `first_loss` NaN.
    """
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
