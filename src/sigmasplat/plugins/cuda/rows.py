"""Step splats from gradient rows on a CUDA device (native/cuda/fit.cu): shape terms, Adam, sums over several images."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sigmasplat.api import (
    ATTRIBUTES,
    BETA1,
    EPSILON,
    SHAPE_TERMS,
    GaussianField,
    Matrix,
    Rates,
    Rows,
    Twist,
    Weights,
    kernel_weights,
)
from sigmasplat.plugins.cuda.launch import blocks_for
from sigmasplat.plugins.cuda.view import CudaView

MOST_COLUMNS = max(ATTRIBUTES.values())
"""Maximum number of columns that the Adam kernel steps."""


def add_shape_gradient(
    view: CudaView, visible: Tensor, field: GaussianField, gradient: Tensor, weights: Weights, frozen_colors: int
) -> Tensor:
    """Add the gradient of the shape terms to the rows [N, 17] of splats in view (uint8 [N]), in place. Set the colour
    gradient of the first `frozen_colors` splats to 0. Return the cost of the shape terms, on the device."""
    n, (isotropy, ratio) = len(field), kernel_weights(SHAPE_TERMS, weights, "cuda").tolist()
    costs = view.raster.empty(blocks_for(n), 1, dtype=torch.float64)
    with view.stages.of("project_backward"):
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
    with view.stages.of("project_backward"):
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
        """Add the view's gradient planes, weighted by their share of the mean. Return the image's own pose twist
        [6]."""
        twist = self._view.backward_on_device(field.params, self._rows, grad2d)
        self.visible |= self._view.raster.visible
        self.grad.add_(self._rows, alpha=share)
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> Tensor:
        """Add the gradient of the shape terms and take Adam's step. Return the cost of the shape terms."""
        cost = add_shape_gradient(self._view, self.visible, field, self.grad, weights, frozen_colors)
        step_rows(self._view, self.visible, field, self.grad, rates)
        return cost
