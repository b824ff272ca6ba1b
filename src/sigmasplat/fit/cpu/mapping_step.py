"""One mapping step, fused in the compiled CPU kernels. Tests compare it with `TorchStep`."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data.field import GaussianField
from sigmasplat.fit.adam import BETA1, EPSILON, Rates
from sigmasplat.fit.fused_terms import PIXEL_TERMS, SHAPE_TERMS, kernel_weights, pixel_weights
from sigmasplat.fit.interface import Weights
from sigmasplat.fit.mapping_step import GradientAccumulator, render_for
from sigmasplat.fit.target import Target
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.native import _core


def step_rows(
    view: CpuView,
    field: GaussianField,
    rates: Rates,
    weights: Weights,
    frozen_colors: int,
    grad2d: Tensor | None,
    harmonics: "_core.Harmonics | None",
) -> tuple[Matrix, float]:
    """Propagate the view's gradient planes to the splats in view and step them, and their harmonics if given, in one
    pass that stores no gradient rows in memory. Returns what `MappingStep.splats` returns."""
    twist, (g_moment, median_id, g_median_depth) = np.zeros(6), view.depth_gradients()
    g_alpha = view.g_alpha if weights.get("mean_depth") else None
    cost = view.raster.step(
        field.params, field.moment1, field.moment2, field.last_step, view.g_sums, g_moment,
        g_alpha, median_id, g_median_depth, rates.per_column.numpy(), BETA1, rates.beta2, EPSILON, field.steps,
        kernel_weights(SHAPE_TERMS, weights, "cpu").tolist(), frozen_colors, harmonics, grad2d, twist,
        view.seconds[3:],
    )  # fmt: skip
    return twist, cost


class CompiledImages:
    """The image terms, fused in the native kernels, on a view's planes (r, g, b, z[, σ²+c² ×3])."""

    def __init__(self, planes: View) -> None:
        from sigmasplat.native import _core

        self.core, self.planes = _core, planes
        self.cache = torch.zeros(_core.ssim_cache_floats(planes.camera.width, planes.camera.height))
        self.parts = np.zeros_like(kernel_weights(PIXEL_TERMS, {}, "cpu"))
        planes.g_alpha.zero_()  # only the term of mean depth writes it

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        width, height, v = target.camera.width, target.camera.height, self.planes
        of_pixels = pixel_weights(weights, "cpu", variance=len(v.sums) >= 7)
        median, g_median = (v.layers.median_depth, v.g_median_depth) if weights.get("median_depth") else (None, None)
        moment, g_moment = (v.moment, v.g_moment) if weights.get("moment") else (None, None)
        alpha, g_alpha = (v.alpha, v.g_alpha) if weights.get("mean_depth") else (None, None)
        self.core.mapping_losses(
            v.sums, median, moment, alpha, target.color, target.depth, height, of_pixels.tolist(),
            target.valid_pixels, v.g_sums, g_median, g_moment, g_alpha, self.parts, target.depth_weight,
        )  # fmt: skip
        loss = float(np.dot(of_pixels, self.parts))
        if weights["ssim"]:
            self.core.ssim_target(target.color, target.depth, width, height, self.cache)
            similarity = self.core.ssim(
                v.sums[:3], target.color, self.cache, width, height, target.depth, -weights["ssim"], v.g_sums[:3]
            )
            loss += weights["ssim"] * (1.0 - similarity)
        return loss


class CompiledStep(CompiledImages):
    """The mapping step, fused in the native kernels. Tests compare it with `TorchStep`."""

    def __init__(self, view: CpuView) -> None:
        super().__init__(view)
        self.view = view

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes."""
        render_for(self.view, field.params, T_camera_world, target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Step the splats as `TorchStep.splats` does."""
        return step_rows(self.view, field, rates, weights, frozen_colors, grad2d, None)

    def accumulator(self, field: GaussianField) -> GradientAccumulator:
        """Allocate the gradient sum of several images."""
        return GradientAccumulator(self.view, field)
