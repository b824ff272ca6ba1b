"""One mapping step, fused in the CUDA kernels (native/cuda/fit.cu). Tests compare it with `TorchStep`."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import Accumulator, GaussianField, Matrix, Rates, Target, Weights, pixel_weights, render_for
from sigmasplat.plugins.cuda.launch import blocks_for
from sigmasplat.plugins.cuda.rows import CudaAccumulator, add_shape_gradient, step_rows
from sigmasplat.plugins.cuda.view import CudaView

TILE = 16
CHANNELS = 3


class CudaStep:
    """The image terms, the backward pass and Adam's step on a device. The host does not wait until `to_host`."""

    def __init__(self, view: CudaView) -> None:
        self.view = view
        (height, width), device = view.alpha.shape, view.alpha.device
        self._size, self._pixels = (width, height), width * height
        self._derivatives = torch.empty(3 * CHANNELS, height, width, device=device)
        self._taps = _gaussian_taps()
        view.g_alpha.zero_()  # only the term of mean depth writes it

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes."""
        render_for(self.view, field.params, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss, on the device."""
        v, per_pixel = self.view, 1.0 / max(target.valid_pixels, 1)
        of_pixels = pixel_weights(weights, "cuda", variance=len(v.sums) >= 7).astype(np.float32)
        median, on_median = (v.layers.median_depth, v.g_median_depth) if weights.get("median_depth") else (None, None)
        moment, on_moment = (v.moment, v.g_moment) if weights.get("moment") else (None, None)
        alpha, on_alpha = (v.alpha, v.g_alpha) if weights.get("mean_depth") else (None, None)
        maps = v.sums, target.color, target.depth, median, moment, alpha
        planes = (*maps, v.g_sums, on_median, on_moment, on_alpha, target.depth_weight)
        blocks = blocks_for(self._pixels)
        sums = v.raster.empty(blocks, 1, dtype=torch.float64)
        v.raster.launch_fit(
            "mapping_losses", blocks, planes, self._pixels, int(len(v.sums) >= 7), per_pixel, of_pixels, sums,
        )  # fmt: skip
        loss = sums.sum()
        return loss + self._ssim(target, weights["ssim"]) if weights["ssim"] else loss

    def _ssim(self, target: Target, weight: float) -> Tensor:
        v, (width, height) = self.view, self._size
        blocks = CHANNELS * -(-width // TILE) * -(-height // TILE)
        given = (v.sums, target.color, target.depth, width, height, self._taps)
        sums = v.raster.empty(blocks, 1, dtype=torch.float64)
        v.raster.launch_fit("ssim", blocks, *given, self._derivatives, sums)
        values = CHANNELS * self._pixels
        v.raster.launch_fit("ssim_backward", blocks, *given, self._derivatives, -weight / values, v.g_sums)
        return weight * (1.0 - sums.sum() / values)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Step the splats as `TorchStep.splats` does; twist and cost stay on the device."""
        view, gradient = self.view, torch.empty_like(field.params)
        twist, visible = view.backward_on_device(field.params, gradient, grad2d), view.raster.visible
        cost = add_shape_gradient(view, visible, field, gradient, weights, frozen_colors)
        step_rows(view, visible, field, gradient, rates)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Allocate the gradient sum of several images."""
        return CudaAccumulator(self.view, field)


def _gaussian_taps() -> NDArray[np.float32]:
    """Return half of SSIM's Gaussian window (σ 1.5 px, 11 wide, normalised), from the centre to the edge, [6]."""
    whole = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    return np.asarray((whole / whole.sum())[5:], np.float32)
