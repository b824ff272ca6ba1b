"""What live images are aligned to: the map rendered somewhere, or a keyframe's own image, weighed by the map's V."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.confidence import uncertainty_weights
from sigmasplat.fit.pyramid import Image, Plane, Pyramid, gray_of, luma
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import PoseMaps, tracking_numbers
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

ALIGN_ALPHA = 0.95
"""Align only where the map is this opaque: there C/A and D/A are the surface's own."""


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights to align others to, and where it was seen from, T_camera_world [4, 4]."""

    pyramid: Pyramid
    T_camera_world: Matrix


def live_image(view: View, color: Image, depth_m: Image, target: Target) -> Pyramid:
    """Halve what a camera sees, colour [H, W, 3] and depth [H, W] m, to be aligned where the view renders.

    On a device it is the target's copy there that is halved.
    """
    if not isinstance(view, CudaView):
        return Pyramid.of(gray_of(color), depth_m, target.camera)
    there, (h, w) = target.on(view.sums.device), depth_m.shape
    return Pyramid.of(luma(there.color[:, :h, :w]), there.depth_image, target.camera)


def map_reference(params: Tensor, view: View, T_camera_world: Matrix, config: TrackingConfig) -> Reference:
    """Render the map as a reference: gray C/A and depth D/A m where it is opaque, weighed by w̃ (VarSplat §3).

    params: rows [N, 17]; T_camera_world [4, 4]: where it is seen from. With depth weighed by U it is rendered twice: U
    is about the surface that the first render finds.
    """
    view.forward(params, T_camera_world)
    maps = _reference_maps(view, config, None)
    if config.align_depth_by == "U":
        view.forward(params, T_camera_world, _tensor(maps.depth))
        maps = _reference_maps(view, config, view.moment)
    return Reference(Pyramid.of(maps.gray, maps.depth, view.camera).weighed(*maps.weights), T_camera_world)


def keyframe_reference(
    params: Tensor, view: View, image: Pyramid, T_camera_world: Matrix, config: TrackingConfig
) -> Reference:
    """Take a keyframe's own image as a reference, each pixel weighed by w̃ of the map seen from there (VarSplat §3).

    params: rows [N, 17]; image: its gray and depth (m) pyramid; T_camera_world [4, 4]: its pose. The sensor's surface
    is unbiased where a young map still renders too near; the map says which pixels to trust. Depth may be weighed by U
    about the sensor's depth instead (CG-SLAM eq. 10).
    """
    if not config.uncertainty:
        return Reference(image, T_camera_world)
    by_U = config.align_depth_by == "U"
    view.forward(params, T_camera_world, _tensor(image.depth[0]) if by_U else None)
    maps = _reference_maps(view, config, view.moment if by_U else None)
    return Reference(image.weighed(*maps.weights), T_camera_world)


class ReferenceMaps(NamedTuple):
    """Gray in [0, 1], surface in m (0 where the map is thin), weights of gray and depth or None, each [H, W]."""

    gray: Plane
    depth: Plane
    weights: tuple[Plane | None, Plane | None]


def _reference_maps(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Read a reference off a view: w̃ averaged over the channels, and the same form of U where its moment is given.

    Where the map is thin V says nothing and the weight is 1, as for depth where there is no U. A view without variance
    gives no w̃: then gray has no weight.
    """
    if isinstance(view, CpuView):
        return _compiled_maps(view, config, moment)
    maps = PoseMaps.of(view)
    opaque, divisor = maps.alpha > ALIGN_ALPHA, maps.alpha.clamp(min=0.5)
    gray, surface = luma(maps.color.movedim(-1, 0)) / divisor, torch.where(opaque, maps.depth / divisor, 0.0)
    weights: list[Plane | None] = [None, None]
    for k, (variance, known) in enumerate(((maps.variance, opaque), (moment, opaque & (view.moment > 0)))):
        if config.uncertainty and variance is not None:
            w = uncertainty_weights(variance.reshape(*opaque.shape, -1), known, config.tau, config.weight_max).mean(-1)
            weights[k] = _plane(view, torch.where(known, w, 1.0))
    return ReferenceMaps(_plane(view, gray), _plane(view, surface), (weights[0], weights[1]))


def _compiled_maps(view: CpuView, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Do the same in the kernels (native/track.h)."""
    from sigmasplat.native import _core

    weighed, by_U = config.uncertainty and len(view.sums) == 7, config.uncertainty and moment is not None
    shape = (view.camera.height, view.camera.width)
    gray, surface, weight, weight_depth = (np.empty(shape, np.float32) for _ in range(4))
    _core.reference_maps(
        view.sums, view.alpha, moment if by_U else None, shape[1], shape[0], tracking_numbers(config, ALIGN_ALPHA),
        weighed, gray, surface, weight, weight_depth,
    )  # fmt: skip
    return ReferenceMaps(gray, surface, (weight if weighed else None, weight_depth if by_U else None))


def _plane(view: View, image: Tensor) -> Plane:
    """Leave an image where the view's planes lie, if it is to be aligned there."""
    return image if isinstance(view, CudaView) else image.numpy()


def _tensor(plane: Plane) -> Tensor:
    return plane if isinstance(plane, Tensor) else torch.tensor(plane)
