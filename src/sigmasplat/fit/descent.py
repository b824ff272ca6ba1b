"""Descend the tracking loss by Adam, one camera's pose and exposure, the field fixed (VarSplat §3; CG-SLAM §6)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.interface import Descent
from sigmasplat.fit.motion import parametrisation
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import tracking_gradient
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

TrackingLoss = Callable[[Any, Target, TrackingConfig, Tensor], tuple[float, Tensor]]


def descend(
    params: Tensor,
    view: View,
    target: Target,
    T_camera_world: Matrix,
    config: TrackingConfig,
    iterations: int,
    tracking_loss: TrackingLoss = tracking_gradient,
) -> Descent:
    """Descend L_track over the numbers that `parametrisation` makes of the pose; the best iterate wins.

    params [N, 17] and target are on the view's device; tracking_loss is what that device computes it by. Ends early
    when a step is below `update_stop`, or when it changed the loss by less than `plateau_stop` of it. Without common
    pixels the guess is returned.
    """
    way = parametrisation(config, T_camera_world)
    numbers, exposure = way.start, np.zeros(2)
    adam, adam_exposure = VectorAdam.of(len(numbers)), VectorAdam.of(2)
    rates = np.array([config.lr_rotation] * way.rotations + [config.lr_translation] * 3)
    rate_exposure = np.full(2, exposure_rate(config))
    best, best_T, best_exposure, first, previous = np.inf, T_camera_world, np.zeros(2), np.inf, np.inf
    steps = 0
    for steps in range(1, iterations + 1):
        T = way.pose(numbers)
        view.forward(params, T)
        loss, g_exposure = tracking_loss(view, target, config, torch.as_tensor(exposure).float())
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
    a, b = best_exposure.tolist()
    return Descent(best_T, (a, b), first, best, steps)


def exposure_rate(config: TrackingConfig) -> float:
    """Return Adam's rate of the exposure: 0 where it is not fitted."""
    return config.lr_exposure if config.exposure else 0.0
