"""Compute the reference maps of alignment from a view, with the compiled CPU kernels (native/track.h)."""

import numpy as np
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.interface import ReferenceMaps
from sigmasplat.fit.reference_maps import ALIGN_ALPHA
from sigmasplat.fit.tracking_loss import tracking_params
from sigmasplat.render.cpu.view import CpuView


def reference_maps(view: CpuView, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Compute `fit.reference_maps.reference_maps` with the kernels; the maps are arrays."""
    from sigmasplat.native import _core

    weighed, by_U = config.uncertainty and len(view.sums) == 7, config.uncertainty and moment is not None
    shape = (view.camera.height, view.camera.width)
    gray, surface, weight, weight_depth = (np.empty(shape, np.float32) for _ in range(4))
    _core.reference_maps(
        view.sums, view.alpha, moment if by_U else None, shape[1], shape[0], tracking_params(config, ALIGN_ALPHA),
        weighed, gray, surface, weight, weight_depth,
    )  # fmt: skip
    return ReferenceMaps(gray, surface, (weight if weighed else None, weight_depth if by_U else None))
