"""From gradient rows to splats on a CUDA device (native/cuda/fit.cu): shape terms, Adam, sums over several images."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, Rates
from sigmasplat.fit.mapping_step import SHAPE_TERMS, Weights
from sigmasplat.model.field import EXTRAS, GaussianField, Rows
from sigmasplat.render.cuda.launch import blocks_for
from sigmasplat.render.cuda.view import CudaView

MOST_COLUMNS = max(EXTRAS.values())
"""Of rows that the kernel steps."""


def pull_shapes(
    view: CudaView, visible: Tensor, field: GaussianField, gradient: Tensor, weights: Weights, frozen_colors: int
) -> Tensor:
    """Add the shape terms' pull on splats in view (uint8 [N]) to their gradient rows [N, 17], in place, and still the
    colours of the first ones; return what those terms cost, on the device."""
    n, (isotropy, ratio) = len(field), (weights.get(name, 0.0) for name in SHAPE_TERMS)
    costs = view.raster.empty(blocks_for(n), 1, dtype=torch.float64)
    with view.stages.of("project_backward"):
        view.raster.launch_fit(
            "shape_terms", blocks_for(n), field.params, visible, visible.sum(dtype=torch.int64), n, frozen_colors,
            isotropy / (3.0 * max(n, 1)), float(ratio), gradient, costs,
        )  # fmt: skip
    return costs.sum()


def step_rows(view: CudaView, visible: Tensor, rows: Rows, gradient: Tensor, rates: Rates) -> None:
    """Do what `adam_step` does for rows in view (uint8 [N]); gradient [N, m] and rates are of the first m columns."""
    used, step = gradient.shape[1], rows.steps
    per_column = np.zeros(MOST_COLUMNS, np.float32)
    per_column[:used] = rates.per_column.numpy()
    numbers = [BETA1, BETA2, EPSILON, 1.0 / (1.0 - BETA1**step), 1.0 / (1.0 - BETA2**step)]
    with view.stages.of("project_backward"):
        view.raster.launch_fit(
            "adam", blocks_for(gradient.numel()), rows.params, rows.moment1, rows.moment2, rows.last_step, visible,
            gradient, gradient.numel(), rows.params.shape[1], used, per_column, np.array(numbers, np.float32), step,
        )  # fmt: skip
    rows.last_step.masked_fill_(visible.bool(), step)


class CudaGathered:
    """Does what `Gathered` does on a device, where all of it stays: the host waits for nothing."""

    def __init__(self, view: CudaView, field: GaussianField) -> None:
        self._view = view
        self.grad, self._rows = torch.zeros_like(field.params), torch.empty_like(field.params)
        self.visible = torch.zeros(len(field), dtype=torch.uint8, device=field.params.device)

    def add(self, field: GaussianField, share: float, pull: Tensor | None = None) -> Tensor:
        """Add the view's gradient planes at their share of the mean; return the image's own pose twist [6]."""
        twist = self._view.backward_there(field.params, self._rows, pull)
        self.visible |= self._view.raster.visible
        self.grad.add_(self._rows, alpha=share)
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> Tensor:
        """Add the shape terms' pull, take Adam's step; return what those terms cost."""
        cost = pull_shapes(self._view, self.visible, field, self.grad, weights, frozen_colors)
        step_rows(self._view, self.visible, field, self.grad, rates)
        return cost
