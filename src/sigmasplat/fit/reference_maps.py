"""Compute the reference maps of alignment from a view: gray, surface, and pixel weights."""

import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.confidence import uncertainty_weights
from sigmasplat.fit.gray import luma
from sigmasplat.fit.interface import ReferenceMaps
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.render.view import View

ALIGN_ALPHA = 0.95
"""Minimum alpha of the map for alignment; above it, C/A and D/A are those of the surface."""


def reference_maps(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Make a reference from a view's last forward pass. Weights: w̃ averaged over the channels; for depth the same
    formula with U, if the view has a moment. The maps are tensors on the device of the view's planes.

    Where the map is thin, V has no meaning and the weight is 1; so is the depth weight without U. Without variance
    there is no w̃, and gray has no weight.
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
    """Return the same maps as arrays, for a view whose planes are in host memory."""
    gray, surface, weights = reference_maps(view, config, moment)
    on_gray, on_depth = (None if weight is None else weight.numpy() for weight in weights)
    return ReferenceMaps(gray.numpy(), surface.numpy(), (on_gray, on_depth))
