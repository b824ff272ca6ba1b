"""One mapping step, fused in the CUDA kernels (native/cuda/fit.cu): image terms, shape terms, Adam, sums over several
images; the same with view-dependent colour (native/cuda/harmonics.cuh). Tests compare it with `TorchStep`.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import (
    ATTRIBUTES,
    BETA1,
    EPSILON,
    SHAPE_TERMS,
    Accumulator,
    GaussianField,
    Matrix,
    Rates,
    Rows,
    Target,
    TorchStep,
    Twist,
    ViewDependentStep,
    Weights,
    kernel_weights,
    pixel_weights,
    render_for,
)
from sigmasplat.plugins.cuda.launch import blocks_for
from sigmasplat.plugins.cuda.view import CudaView

TILE = 16
CHANNELS = 3
MOST_COLUMNS = max(ATTRIBUTES.values())
"""Maximum number of columns that the Adam kernel steps."""


def add_shape_gradient(
    view: CudaView, visible: Tensor, field: GaussianField, gradient: Tensor, weights: Weights, frozen_colors: int
) -> Tensor:
    """Add the gradient of the shape terms to the rows [N, 17] of splats in view (uint8 [N]), in place. Set the colour
    gradient of the first `frozen_colors` splats to 0. Return the cost of the shape terms, on the device."""
    n, (isotropy, ratio) = len(field), kernel_weights(SHAPE_TERMS, weights).tolist()
    costs = view.raster.empty(blocks_for(n), 1, dtype=torch.float64)
    view.raster.launch_fit(
        "shape_terms", blocks_for(n), field.params, visible, visible.sum(dtype=torch.int64), n, frozen_colors,
        isotropy / (3.0 * max(n, 1)), float(ratio), gradient, costs,
    )  # fmt: skip
    return costs.sum()


def step_rows(view: CudaView, visible: Tensor, rows: Rows, gradient: Tensor, rates: Rates) -> None:
    """Step the visible rows (uint8 [N]) as `adam_step` does; gradient [N, m] and rates are for the first m columns."""
    used, step = gradient.shape[1], rows.steps
    per_column = np.zeros(MOST_COLUMNS, np.float32)
    per_column[:used] = rates.per_column.numpy()
    beta2 = rates.beta2
    numbers = [BETA1, beta2, EPSILON, 1.0 / (1.0 - BETA1**step), 1.0 / (1.0 - beta2**step)]
    view.raster.launch_fit(
        "adam", blocks_for(gradient.numel()), rows.params, rows.moment1, rows.moment2, rows.last_step, visible,
        gradient, gradient.numel(), rows.params.shape[1], used, per_column, np.array(numbers, np.float32), step,
    )  # fmt: skip
    rows.last_step.masked_fill_(visible.bool(), step)


def to_host(twists: Sequence[Twist], costs: Sequence[float | Tensor]) -> tuple[list[Matrix], list[float]]:
    """Return twists and costs in host memory; waits once for all values that are on a device."""
    on_device = [x.double().reshape(-1) for x in (*twists, *costs) if isinstance(x, Tensor)]
    found = torch.cat(on_device).cpu().numpy() if on_device else np.empty(0)
    parts = iter(np.split(found, np.cumsum([len(x) for x in on_device])))
    on_host = [next(parts) if isinstance(x, Tensor) else x for x in twists]
    return on_host, [float(next(parts)[0]) if isinstance(x, Tensor) else x for x in costs]


class CudaAccumulator:
    """`GradientAccumulator` on a device; the host does not wait."""

    def __init__(self, view: CudaView, field: GaussianField) -> None:
        self._view = view
        self.grad, self._rows = torch.zeros_like(field.params), torch.empty_like(field.params)
        self.visible = torch.zeros(len(field), dtype=torch.uint8, device=field.params.device)

    def add(self, field: GaussianField, share: float, grad2d: Tensor | None = None) -> Tensor:
        twist = self._view.backward_on_device(field.params, self._rows, grad2d)
        self.visible |= self._view.raster.visible
        self.grad.add_(self._rows, alpha=share)
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> Tensor:
        cost = add_shape_gradient(self._view, self.visible, field, self.grad, weights, frozen_colors)
        step_rows(self._view, self.visible, field, self.grad, rates)
        return cost


class CudaStep(TorchStep):
    """The image terms, the backward pass and Adam's step on a device. The host does not wait until `to_host`."""

    view: CudaView

    def __init__(self, view: CudaView) -> None:
        super().__init__(view)
        (height, width), device = view.alpha.shape, view.alpha.device
        self._size, self._pixels = (width, height), width * height
        self._derivatives = torch.empty(3 * CHANNELS, height, width, device=device)
        self._taps = _gaussian_taps()

    def images(self, target: Target, weights: Weights) -> Tensor:
        v, per_pixel = self.view, 1.0 / max(target.valid_pixels, 1)
        of_pixels = pixel_weights(weights, variance=len(v.sums) >= 7).astype(np.float32)
        median, on_median = (v.layers.median_depth, v.g_median_depth) if weights.get("median_depth") else (None, None)
        moment, on_moment = (v.moment, v.g_moment) if weights.get("moment") else (None, None)
        alpha, on_alpha = (v.alpha, v.g_alpha) if weights.get("mean_depth") else (None, None)
        maps = v.sums, target.color, target.depth, median, moment, alpha
        planes = (*maps, v.g_sums, on_median, on_moment, on_alpha, None)
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
        view, gradient = self.view, torch.empty_like(field.params)
        twist, visible = view.backward_on_device(field.params, gradient, grad2d), view.raster.visible
        cost = add_shape_gradient(view, visible, field, gradient, weights, frozen_colors)
        step_rows(view, visible, field, gradient, rates)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        return CudaAccumulator(self.view, field)


def _gaussian_taps() -> NDArray[np.float32]:
    """Return half of SSIM's Gaussian window (σ 1.5 px, 11 wide, normalised), from the centre to the edge, [6]."""
    whole = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    return np.asarray((whole / whole.sum())[5:], np.float32)


class CudaViewDependentStep(ViewDependentStep):
    """`ViewDependentStep` on a device. The host does not wait until `to_host`."""

    view: CudaView
    _eye: NDArray[np.float32]

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        harmonics, n = field.get_or_create("harmonics").params, len(field)
        self.rows, self._eye = field.params.clone(), _eye(T_camera_world)
        self.view.raster.launch_fit(
            "show_colors", blocks_for(n), self.rows, harmonics, n, self.degree, harmonics.shape[1], self._eye
        )
        render_for(self.view, self.rows, T_camera_world, target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        view, gradient, harmonics = self.view, torch.empty_like(field.params), field.get_or_create("harmonics")
        twist, visible = view.backward_on_device(self.rows, gradient, grad2d), view.raster.visible
        cost = add_shape_gradient(view, visible, field, gradient, weights, frozen_colors)
        on_harmonics, on_camera = self._back_through_colors(field, visible, gradient)
        twist[:3] += on_camera
        step_rows(view, visible, field, gradient, rates)
        harmonics.steps += 1
        of_harmonics = Rates(rates.of_attribute("harmonics").per_column[: self.width], rates.beta2)
        step_rows(view, visible, harmonics, on_harmonics, of_harmonics)
        return twist, cost

    def _back_through_colors(self, field: GaussianField, visible: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Propagate the gradient of the colours, in rows [N, 17], to the harmonics and through the viewing direction.

        Returns the gradient of the harmonics [N, width] and of the camera's translation [3]. The gradient of the means
        is added to the same rows.
        """
        raster, n, harmonics = self.view.raster, len(field), field.get_or_create("harmonics").params
        found, partial = raster.empty(n, self.width), raster.empty(blocks_for(n), 3, dtype=torch.float64)
        raster.launch_fit(
            "carry_colors", blocks_for(n), field.params, harmonics, visible, n, self.degree, harmonics.shape[1],
            self.width, self._eye, gradient, found, partial,
        )  # fmt: skip
        return found, partial.sum(0)


def _eye(T_camera_world: Matrix) -> NDArray[np.float32]:
    """Return the kernels' `Eye` [15]: the camera's position, and R and t of its pose."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    return np.concatenate([-R.T @ t, R.ravel(), t]).astype(np.float32)
