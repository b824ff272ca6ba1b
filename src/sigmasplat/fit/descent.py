"""Minimise the tracking loss by Adam over one camera's pose and exposure, with a fixed field (VarSplat §3; CG-SLAM
§6)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.adam import VectorAdam, VectorAmsgrad
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
        loss, g_exposure = tracking_loss(view, target, config, torch.as_tensor(exposure).float())
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


def exposure_rate(config: TrackingConfig) -> float:
    """Return Adam's learning rate of the exposure; 0 if exposure is not fitted."""
    return config.lr_exposure if config.exposure else 0.0
