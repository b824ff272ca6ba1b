"""What alignment reads off a view: gray, surface, and how much each pixel counts."""

import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.confidence import uncertainty_weights
from sigmasplat.fit.gray import luma
from sigmasplat.fit.interface import ReferenceMaps
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.render.view import View

ALIGN_ALPHA = 0.95
"""Align only where the map is this opaque, so that C/A and D/A are those of the surface."""


def reference_maps(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Read a reference off a view's last forward pass: w̃ averaged over the channels, and the same form of U where its
    moment is given. The maps are tensors where the view's planes are.

    Where the map is thin V has no meaning and the weight is 1, as for depth where there is no U. A view without
    variance gives no w̃: then gray has no weight.
    """
    maps = PoseMaps.of(view)
    opaque, divisor = maps.alpha > ALIGN_ALPHA, maps.alpha.clamp(min=0.5)
    gray, surface = luma(maps.color.movedim(-1, 0)) / divisor, torch.where(opaque, maps.depth / divisor, 0.0)
    weights: list[Tensor | None] = [None, None]
    for k, (variance, known) in enumerate(((maps.variance, opaque), (moment, opaque & (view.moment > 0)))):
        if config.uncertainty and variance is not None:
            w = uncertainty_weights(variance.reshape(*opaque.shape, -1), known, config.tau, config.weight_max).mean(-1)
            weights[k] = torch.where(known, w, 1.0)
    return ReferenceMaps(gray, surface, (weights[0], weights[1]))


def reference_arrays(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Return the same as arrays, for a view whose planes are in the host's memory."""
    gray, surface, weights = reference_maps(view, config, moment)
    on_gray, on_depth = (None if weight is None else weight.numpy() for weight in weights)
    return ReferenceMaps(gray.numpy(), surface.numpy(), (on_gray, on_depth))
