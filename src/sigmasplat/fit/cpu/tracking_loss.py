"""Compute the tracking loss with the compiled CPU kernels (native/track.h): medians, weights and gradient in one
call."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import tracking_params
from sigmasplat.render.cpu.view import CpuView


def tracking_gradient(view: CpuView, target: Target, config: TrackingConfig, exposure: Tensor) -> tuple[float, Tensor]:
    """Compute `fit.tracking_loss.tracking_gradient` with the kernels."""
    from sigmasplat.native import _core

    g_exposure, camera = np.zeros(2), view.camera
    loss = _core.tracking_loss(
        view.sums, view.alpha, target.color, target.depth, camera.width, camera.height,
        tracking_params(config, config.alpha_above), config.uncertainty, config.average == "kept",
        float(exposure[0].exp()), float(exposure[1]), view.g_sums, g_exposure,
    )  # fmt: skip
    return loss, torch.as_tensor(g_exposure, dtype=exposure.dtype)
