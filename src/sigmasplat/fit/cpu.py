"""The fits on the compiled CPU kernels: images in host memory, mapping steps, the tracking loss, reference maps.

Definitions and docstrings are those of what each replaces (`fit.interface`, `fit.backends`). Tests compare both.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.fit.adam import BETA1, EPSILON, Rates
from sigmasplat.fit.interface import (
    DEPTH_STEP_M,
    NORMAL_TERMS,
    AlignedPose,
    AlignRules,
    ImageKernels,
    LevelPlanes,
    ReferenceMaps,
    Weights,
)
from sigmasplat.fit.losses import PIXEL_TERMS, SHAPE_TERMS, kernel_weights, pixel_weights, take
from sigmasplat.fit.mapping_step import TorchStep, ViewDependentStep
from sigmasplat.fit.target import Image, Target, gray_of
from sigmasplat.fit.tracking_loss import ALIGN_ALPHA, tracking_params
from sigmasplat.native import _core
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

Half = Image | None


# ---- images ----


def halve(averaged: tuple[Half, Half], depth: Half, step_m: float) -> tuple[Half, Half, Half]:
    """Implement `ImageKernels.halve`."""
    first, second = (None if image is None else halved(image) for image in averaged)
    return first, second, None if depth is None else halved_depth(depth, step_m)


def halved(image: Image) -> Image:
    """Return the mean of each 2×2 cell of an image [H, W], as [H/2, W/2]."""
    half = np.empty((image.shape[0] // 2, image.shape[1] // 2), np.float32)
    _core.halve(image, half)
    return half


def halved_depth(depth: Image, step_m: float = DEPTH_STEP_M) -> Image:
    """Average the readings of 2×2 cells. A cell gets no reading if it has a single one or contains a depth step."""
    half = np.empty((depth.shape[0] // 2, depth.shape[1] // 2), np.float32)
    _core.halve_depth(depth, step_m, half)
    return half


def readings_of(finest: Image, coarsest: Image) -> Matrix:
    """Implement `ImageKernels.readings_of`."""
    read = coarsest[coarsest > 0]
    return np.array([float(read.mean()) if len(read) else 1.0, float((finest > 0).sum())])


def align(levels: Sequence[LevelPlanes], readings: Matrix, T_live_reference: Matrix, rules: AlignRules) -> AlignedPose:
    """Align from the coarsest level (the last one) to the finest, in one call of the kernels."""
    (depth_m, n), T, found = readings.tolist(), np.array(T_live_reference, np.float64), np.zeros(6)
    r = rules
    steps, degenerate = _core.align_images(
        [_laid_out(level) for level in levels], r.iterations, r.update_stop, r.plateau_stop, depth_m,
        r.degenerate_share, r.min_pixels, T, found,
    )  # fmt: skip
    return AlignedPose(T, found[:5], steps, degenerate, depth_m, n, float(found[5]))


def normal_equations(level: LevelPlanes, motions: Sequence[Matrix], whole: int) -> Matrix:
    """Implement `ImageKernels.normal_equations`."""
    rows = np.zeros((len(motions), NORMAL_TERMS))
    _core.align_steps(_laid_out(level), np.ascontiguousarray(motions, np.float64), whole, rows)
    return rows


def _laid_out(level: LevelPlanes) -> _core.Level:
    planes: tuple[Any, ...] = level
    return _core.Level(*planes)


def live_planes(view: View, color: Image, depth_m: Image, target: Target) -> tuple[Image, Image]:
    """Return gray and depth [H, W] of a frame."""
    return gray_of(color), depth_m


CPU_IMAGES = ImageKernels(
    np.ascontiguousarray, np.asarray, lambda array, plane: array, torch.tensor, halve, readings_of, align,
    normal_equations,
)  # fmt: skip


# ---- mapping ----


def settle(field: Rows, rates: Rates) -> None:
    """Settle the rows of a field's 17 columns, as `fit.adam.settle` does (native/adam.h)."""
    _core.adam_settle(
        field.params, field.moment1, field.moment2, field.last_step, rates.per_column.numpy(),
        BETA1, rates.beta2, EPSILON, field.steps,
    )  # fmt: skip


def step_rows(
    view: CpuView, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None,
    harmonics: _core.Harmonics | None,
) -> tuple[Matrix, float]:  # fmt: skip
    """Propagate the view's gradient planes to the splats in view and step them, and their harmonics if given, in one
    pass that stores no gradient rows in memory. Returns what `MappingStep.splats` returns."""
    twist, (g_moment, median_id, g_median_depth) = np.zeros(6), view.depth_gradients()
    g_alpha = view.g_alpha if take(weights, "alpha") else None
    cost = view.raster.step(
        field.params, field.moment1, field.moment2, field.last_step, view.g_sums, g_moment,
        g_alpha, median_id, g_median_depth, rates.per_column.numpy(), BETA1, rates.beta2, EPSILON, field.steps,
        kernel_weights(SHAPE_TERMS, weights).tolist(), frozen_colors, harmonics, grad2d, twist,
        view.seconds[3:],
    )  # fmt: skip
    return twist, cost


class CompiledStep(TorchStep):
    """The mapping step, fused in the kernels, on a view's planes (r, g, b, z[, σ²+c² ×3])."""

    view: CpuView

    def __init__(self, view: View) -> None:
        super().__init__(view)
        self.cache = torch.zeros(_core.ssim_cache_floats(view.camera.width, view.camera.height))
        self.parts = np.zeros(len(PIXEL_TERMS))

    def images(self, target: Target, weights: Weights) -> float:
        width, height, v = target.camera.width, target.camera.height, self.view
        of_pixels = pixel_weights(weights, variance=len(v.sums) >= 7)
        median, g_median = (v.layers.median_depth, v.g_median_depth) if weights.get("median_depth") else (None, None)
        moment, g_moment = (v.moment, v.g_moment) if weights.get("moment") else (None, None)
        alpha, g_alpha = (v.alpha, v.g_alpha) if weights.get("mean_depth") else (None, None)
        _core.mapping_losses(
            v.sums, median, moment, alpha, target.color, target.depth, height, of_pixels.tolist(),
            target.valid_pixels, v.g_sums, g_median, g_moment, g_alpha, self.parts,
        )  # fmt: skip
        loss = float(np.dot(of_pixels, self.parts))
        if weights["ssim"]:
            _core.ssim_target(target.color, target.depth, width, height, self.cache)
            similarity = _core.ssim(
                v.sums[:3], target.color, self.cache, width, height, target.depth, -weights["ssim"], v.g_sums[:3]
            )
            loss += weights["ssim"] * (1.0 - similarity)
        return loss

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        return step_rows(self.view, field, rates, weights, frozen_colors, grad2d, None)


class CompiledViewDependentStep(ViewDependentStep):
    """`ViewDependentStep` in the kernels (native/view_colors.h): one pass computes the gradients of splats and
    harmonics and steps both."""

    view: CpuView

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        reference = target.depth_image if take(weights, "moment") else None
        harmonics, layers = self._harmonics(field, 0.0), take(weights, "median_depth")
        self.view.forward(field.params, T_camera_world, reference, layers=layers, harmonics=harmonics)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        field.get_or_create("harmonics").steps += 1
        harmonics = self._harmonics(field, float(rates.of_attribute("harmonics").per_column[0]))
        return step_rows(self.view, field, rates, weights, frozen_colors, grad2d, harmonics)

    def _harmonics(self, field: GaussianField, rate: float) -> _core.Harmonics:
        h = field.get_or_create("harmonics")
        return _core.Harmonics(h.params, h.moment1, h.moment2, h.last_step, self.degree, h.steps, rate)


# ---- tracking ----


def tracking_gradient(view: CpuView, target: Target, config: TrackingConfig, exposure: Tensor) -> tuple[float, Tensor]:
    """Compute `fit.tracking_loss.tracking_gradient`, in one call (native/track.h)."""
    g_exposure, camera = np.zeros(2), view.camera
    loss = _core.tracking_loss(
        view.sums, view.alpha, target.color, target.depth, camera.width, camera.height,
        tracking_params(config, config.alpha_above), config.uncertainty, config.average == "kept",
        float(exposure[0].exp()), float(exposure[1]), view.g_sums, g_exposure,
    )  # fmt: skip
    return loss, torch.as_tensor(g_exposure, dtype=exposure.dtype)


def reference_maps(view: CpuView, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Compute `fit.tracking_loss.reference_maps` (native/track.h); the maps are arrays."""
    weighed, by_U = config.uncertainty and len(view.sums) == 7, config.uncertainty and moment is not None
    shape = (view.camera.height, view.camera.width)
    gray, surface, weight, weight_depth = (np.empty(shape, np.float32) for _ in range(4))
    _core.reference_maps(
        view.sums, view.alpha, moment if by_U else None, shape[1], shape[0], tracking_params(config, ALIGN_ALPHA),
        weighed, gray, surface, weight, weight_depth,
    )  # fmt: skip
    return ReferenceMaps(gray, surface, (weight if weighed else None, weight_depth if by_U else None))
