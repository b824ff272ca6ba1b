"""Step every splat by Adam (Kingma & Ba 2015), a learning rate per column of the field."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.model.field import COLUMNS, WIDTH, GaussianField

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass(frozen=True, eq=False)
class Rates:
    """Learning rates [17], one per column of `GaussianField.params`; 0 freezes a column."""

    per_column: Tensor

    @staticmethod
    def of(config: MappingConfig) -> "Rates":
        """Read them from the mapping settings (VarSplat §2)."""
        rates = torch.zeros(WIDTH)
        for name, columns in COLUMNS.items():
            rates[columns] = getattr(config, f"lr_{name}")
        return Rates(rates)


def adam_step(field: GaussianField, grad: Tensor, rates: Rates, visible: Tensor) -> None:
    """Move the rows of `field.params` in view (bool [N]) against grad [N, 17], in place; `field.steps` is this step.

    Rows out of view wait. What dense Adam would have done to one meanwhile, coast on its decaying moments, is made up
    for when it is seen again (`_catch_up`) or by `settle`. The native kernels do the same, fused (native/adam.h).
    """
    rows = visible.nonzero().squeeze(1)
    params, moment1, moment2 = _catch_up(field, rows, rates, field.steps - 1)
    g = grad[rows]
    moment1 = BETA1 * moment1 + (1 - BETA1) * g
    moment2 = BETA2 * moment2 + (1 - BETA2) * g * g
    unbiased1, unbiased2 = moment1 / (1 - BETA1**field.steps), moment2 / (1 - BETA2**field.steps)
    field.params[rows] = params - rates.per_column * unbiased1 / (unbiased2.sqrt() + EPSILON)
    field.moment1[rows], field.moment2[rows], field.last_step[rows] = moment1, moment2, field.steps


def settle(field: GaussianField, rates: Rates, compiled: bool) -> None:
    """Bring every row to the present step, as dense Adam would have it: to be called when a fit ends."""
    if compiled:
        from sigmasplat.native import _core

        _core.adam_settle(
            field.params, field.moment1, field.moment2, field.last_step, rates.per_column.numpy(),
            BETA1, BETA2, EPSILON, field.steps,
        )  # fmt: skip
        return
    rows = (field.last_step != field.steps).nonzero().squeeze(1)
    field.params[rows], field.moment1[rows], field.moment2[rows] = _catch_up(field, rows, rates, field.steps)
    field.last_step[rows] = field.steps


def _catch_up(field: GaussianField, rows: Tensor, rates: Rates, to: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return params and moments of rows as dense Adam without a gradient would have left them after step `to`.

    A step without gradient is β₁/√β₂ times the one before it, so that the missed ones add up to a geometric series.
    Left out is only how the bias correction changes meanwhile.
    """
    last = field.last_step[rows][:, None].to(field.params)
    missed, ratio, moved = to - last, BETA1 / BETA2**0.5, last > 0
    steps = torch.where(moved, ratio * (1 - ratio**missed) / (1 - ratio), 0.0)
    moment1, moment2 = field.moment1[rows], field.moment2[rows]
    unbiased1 = moment1 / torch.where(moved, 1 - BETA1**last, 1.0)
    unbiased2 = moment2 / torch.where(moved, 1 - BETA2**last, 1.0)
    params = field.params[rows] - rates.per_column * steps * unbiased1 / (unbiased2.sqrt() + EPSILON)
    return params, moment1 * BETA1**missed, moment2 * BETA2**missed


@dataclass(eq=False)
class VectorAdam:
    """Adam on a few numbers: a pose's twist, where each step starts from the pose of the last, or its coordinates."""

    moment1: NDArray[np.float64]
    moment2: NDArray[np.float64]
    steps: int = 0

    @staticmethod
    def of(size: int) -> "VectorAdam":
        """Start at rest on so many numbers."""
        return VectorAdam(np.zeros(size), np.zeros(size))

    def step(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the update for a gradient, a rate for each number."""
        self.steps += 1
        self.moment1 += (1 - BETA1) * (gradient - self.moment1)
        self.moment2 += (1 - BETA2) * (gradient**2 - self.moment2)
        unbiased1 = self.moment1 / (1 - BETA1**self.steps)
        unbiased2 = self.moment2 / (1 - BETA2**self.steps)
        return np.asarray(-rates * unbiased1 / (np.sqrt(unbiased2) + EPSILON))
