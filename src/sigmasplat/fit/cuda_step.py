"""One mapping step fused in the CUDA kernels (native/fit.cu), on a view of theirs; tests hold it to `TorchStep`."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, Rates
from sigmasplat.fit.step import SHAPE_TERMS, Weights, render_for
from sigmasplat.fit.target import Target
from sigmasplat.model.field import GaussianField
from sigmasplat.render.cuda_launch import blocks_for
from sigmasplat.render.cuda_view import CudaView
from sigmasplat.render.view import Matrix

LOCAL_TERMS = ("l1", "depth", "nll_color", "nll_depth", "alignment", "moment")
TILE = 16
CHANNELS = 3


class Loss:
    """A loss on a device; the host waits for it when it is first read, unless it came with something else before."""

    def __init__(self, there: Tensor) -> None:
        self.there, self.here = there, np.nan

    def __float__(self) -> float:
        if np.isnan(self.here):
            self.here = float(self.there)
        return self.here


class CudaStep:
    """The image terms, the way back and Adam's step on a device. The host waits once, at its end, for twist and loss
    together."""

    def __init__(self, view: CudaView) -> None:
        self.view = view
        (height, width), device = view.alpha.shape, view.alpha.device
        self._size, self._pixels = (width, height), width * height
        self._derivatives = torch.empty(3 * CHANNELS, height, width, device=device)
        self._taps, self._loss = _gaussian_taps(), Loss(torch.zeros((), dtype=torch.float64, device=device))

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field to the view's planes."""
        render_for(self.view, field.params, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> Loss:
        """Write the gradient of every image term to the view's gradient planes; return the loss, on its way."""
        v, per_pixel = self.view, 1.0 / max(target.valid_pixels, 1)
        local = np.array([weights.get(name, 0.0) for name in LOCAL_TERMS])
        local[2:4] *= len(v.sums) >= 7
        median, on_median = (v.layers.median_depth, v.g_median_depth) if local[4] else (None, None)
        moment, on_moment = (v.moment, v.g_moment) if local[5] else (None, None)
        planes = (v.sums, target.color, target.depth, median, moment, v.g_sums, on_median, on_moment)
        blocks = blocks_for(self._pixels)
        sums = v.raster.empty(blocks, 1, dtype=torch.float64)
        v.raster.launch_fit(
            "mapping_losses", blocks, planes, self._pixels, int(len(v.sums) >= 7), per_pixel, local.astype(np.float32),
            sums,
        )  # fmt: skip
        loss = sums.sum()
        self._loss = Loss(loss + self._ssim(target, weights["ssim"]) if weights["ssim"] else loss)
        return self._loss

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
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, pull: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Do what `TorchStep.splats` does."""
        raster, n, gradient = self.view.raster, len(field), torch.empty_like(field.params)
        twist = self.view.backward_there(field.params, gradient, pull)
        visible, (isotropy, ratio) = raster.visible, (weights.get(name, 0.0) for name in SHAPE_TERMS)
        costs = raster.empty(blocks_for(n), 1, dtype=torch.float64)
        raster.launch_fit(
            "shape_terms", blocks_for(n), field.params, visible, visible.sum(dtype=torch.int64), n, frozen_colors,
            isotropy / (3.0 * max(n, 1)), float(ratio), gradient, costs,
        )  # fmt: skip
        numbers = [BETA1, BETA2, EPSILON, 1.0 / (1.0 - BETA1**field.steps), 1.0 / (1.0 - BETA2**field.steps)]
        raster.launch_fit(
            "adam", blocks_for(gradient.numel()), field.params, field.moment1, field.moment2, field.last_step, visible,
            gradient, gradient.numel(), rates.per_column.numpy(), np.array(numbers, np.float32), field.steps,
        )  # fmt: skip
        field.last_step.masked_fill_(visible.bool(), field.steps)
        found = torch.cat([twist, costs.sum(0), self._loss.there[None]]).cpu().numpy()
        self._loss.here = float(found[7])
        return found[:6], float(found[6])


def _gaussian_taps() -> NDArray[np.float32]:
    """Return the Gaussian of SSIM's window (σ 1.5 px, 11 wide, normalised) from its middle out, [6]."""
    whole = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    return np.asarray((whole / whole.sum())[5:], np.float32)
