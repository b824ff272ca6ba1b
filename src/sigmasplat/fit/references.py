"""What live images are aligned to: the map rendered somewhere, or a keyframe's own image, weighed by the map's V."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.align import LUMA, Image, Pyramid
from sigmasplat.fit.confidence import uncertainty_weights
from sigmasplat.fit.tracking_loss import PoseMaps, tracking_numbers
from sigmasplat.render.view import CpuView, View

Matrix = NDArray[np.float64]
ALIGN_ALPHA = 0.95
"""Align only where the map is this opaque: there C/A and D/A are the surface's own."""


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights to align others to, and where it was seen from, T_camera_world [4, 4]."""

    pyramid: Pyramid
    T_camera_world: Matrix


def map_reference(params: Tensor, view: View, T_camera_world: Matrix, config: TrackingConfig) -> Reference:
    """Render the map as a reference: gray C/A and depth D/A where it is opaque, weighed by w̃ (VarSplat §3)."""
    view.forward(params, T_camera_world)
    gray, surface, weight = _reference_maps(view, config)
    return Reference(Pyramid.of(gray, surface, view.camera, weight), T_camera_world)


def keyframe_reference(
    params: Tensor, view: View, image: Pyramid, T_camera_world: Matrix, config: TrackingConfig
) -> Reference:
    """Take a keyframe's own image as a reference, each pixel weighed by w̃ of the map seen from there (VarSplat §3).

    The sensor's surface is unbiased where a young map still renders too near; the map says which pixels to trust.
    """
    if not config.uncertainty:
        return Reference(image, T_camera_world)
    view.forward(params, T_camera_world)
    _, _, weight = _reference_maps(view, config)
    return Reference(image.weighed(weight), T_camera_world)


def _reference_maps(view: View, config: TrackingConfig) -> tuple[Image, Image, Image | None]:
    """Read gray, surface (0 where the map is thin) and w̃ averaged over the channels off a view, each [H, W].

    Where the map is thin V says nothing and the weight is 1; without uncertainty the weight is None.
    """
    weighed = config.uncertainty and len(view.sums) == 7
    if isinstance(view, CpuView):
        from sigmasplat.native import _core

        shape = (view.camera.height, view.camera.width)
        gray, surface, weight = (np.empty(shape, np.float32) for _ in range(3))
        numbers = tracking_numbers(config, ALIGN_ALPHA)
        _core.reference_maps(view.sums, view.alpha, shape[1], shape[0], numbers, weighed, gray, surface, weight)
        return gray, surface, weight if weighed else None
    maps = PoseMaps.of(view)
    opaque, divisor = maps.alpha > ALIGN_ALPHA, maps.alpha.clamp(min=0.5)
    gray = ((maps.color @ torch.from_numpy(LUMA)) / divisor).numpy()
    surface = torch.where(opaque, maps.depth / divisor, 0.0).numpy()
    if not weighed or maps.variance is None:
        return gray, surface, None
    mean = uncertainty_weights(maps.variance, opaque, config.tau, config.weight_max).mean(-1)
    return gray, surface, torch.where(opaque, mean, 1.0).numpy()
