"""Update splats with Adam (Kingma & Ba 2015), with a learning rate per column of the field."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.data.field import ATTRIBUTES, COLUMNS, WIDTH, Rows

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
ATTRIBUTE_RATES = {"harmonics": ("colors", 1.0 / 20.0)}
"""Learning rate of an attribute, relative to the rate of the named columns. Harmonics: the value of 3DGS."""
ROWS_AT_ONCE = 8192
"""This many rows and their intermediate results fit in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Rates:
    """Learning rates [m], one per column of `GaussianField.params` or of an attribute; 0 freezes a column. beta2: the
    decay of Adam's second moment."""

    per_column: Tensor
    beta2: float = BETA2

    @staticmethod
    def of(config: MappingConfig) -> "Rates":
        """Make the rates from the mapping settings (VarSplat §2)."""
        rates = torch.zeros(WIDTH)
        for name, columns in COLUMNS.items():
            rates[columns] = getattr(config, f"lr_{name}")
        return Rates(rates)

    @staticmethod
    def falling(config: MappingConfig, steps: int) -> "Iterator[Rates]":
        """Yield the rates of the first keyframe's steps. The rate of the means decays exponentially from
        `lr_means_first` to `lr_means`."""
        for step in range(steps):
            rates = Rates.of(config)
            if config.lr_means_first and config.lr_means:
                left = 1.0 - step / max(steps - 1, 1)
                rates.per_column[COLUMNS["means"]] *= (config.lr_means_first / config.lr_means) ** left
            yield rates

    def of_attribute(self, name: str) -> "Rates":
        """Return the rates of an attribute, for a field that has these rates."""
        columns, share = ATTRIBUTE_RATES[name]
        rate = share * float(self.per_column[COLUMNS[columns]][0])
        return Rates(self.per_column.new_full((ATTRIBUTES[name],), rate), self.beta2)


def adam_step(field: Rows, grad: Tensor, rates: Rates, visible: Tensor) -> None:
    """Step the visible rows (bool [N]) of `field.params` with the gradient grad [N, m], in place. `field.steps` is the
    number of this step.

    Invisible rows are not changed now. Dense Adam would still move them, because its moments decay slowly. This missed
    motion is added when the row is visible again (`_catch_up`), or by `settle`. The native kernels do the same in one
    fused pass (native/adam.h).
    """
    for rows in torch.split(visible.nonzero().squeeze(1), ROWS_AT_ONCE):
        adam_rows(field, rows, grad[rows], rates)


def adam_rows(field: Rows, rows: Tensor, g: Tensor, rates: Rates) -> None:
    """Step the rows with indices [n] with their gradients g [n, m], as `adam_step` does."""
    params, moment1, moment2 = _catch_up(field, rows, rates, field.steps - 1)
    beta2 = rates.beta2
    moment1.lerp_(g, 1 - BETA1)
    moment2.mul_(beta2).addcmul_(g, g, value=1 - beta2)
    _move(params, moment1, moment2, rates, 1 / (1 - BETA1**field.steps), (1 - beta2**field.steps) ** -0.5)
    for all_rows, some in ((field.params, params), (field.moment1, moment1), (field.moment2, moment2)):
        all_rows.index_copy_(0, rows, some)
    field.last_step[rows] = field.steps


def settle(field: Rows, rates: Rates) -> None:
    """Apply the missed motion to every row, as in dense Adam. Call this when a fit ends."""
    rows = (field.last_step != field.steps).nonzero().squeeze(1)
    field.params[rows], field.moment1[rows], field.moment2[rows] = _catch_up(field, rows, rates, field.steps)
    field.last_step[rows] = field.steps


def _catch_up(field: Rows, rows: Tensor, rates: Rates, to: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return params and moments of rows as dense Adam with zero gradient would leave them after step `to`.

    Each step with zero gradient is β₁/√β₂ times the step before, so the missed steps are a geometric series. The change
    of the bias correction during these steps is neglected.
    """
    last = field.last_step[rows][:, None].to(field.params)
    missed, ratio, moved = to - last, BETA1 / rates.beta2**0.5, last > 0
    params, moment1, moment2 = (x.index_select(0, rows) for x in (field.params, field.moment1, field.moment2))
    if bool((missed > 0).any()):
        steps = torch.where(moved, ratio * (1 - ratio**missed) / (1 - ratio), 0.0)
        unbias1 = steps / torch.where(moved, 1 - BETA1**last, 1.0)
        _move(params, moment1, moment2, rates, unbias1, torch.where(moved, 1 - rates.beta2**last, 1.0).rsqrt())
        moment1.mul_(BETA1**missed)
        moment2.mul_(rates.beta2**missed)
    return params, moment1, moment2


def _move(
    params: Tensor, moment1: Tensor, moment2: Tensor, rates: Rates, unbias1: Tensor | float, unbias2: Tensor | float
) -> None:
    """Apply Adam's step to rows in place. unbias1, unbias2: for the bias of moment1 and of the root of moment2."""
    spread = moment2.sqrt().mul_(unbias2).add_(EPSILON)
    params.addcmul_((moment1 * unbias1).div_(spread), rates.per_column.to(params.device), value=-1.0)


@dataclass(eq=False)
class VectorAdam:
    """Adam for a small vector: the parameters of a pose, or its twist. With a twist, each step starts from the pose of
    the step before."""

    moment1: NDArray[np.float64]
    moment2: NDArray[np.float64]
    steps: int = 0

    @classmethod
    def of(cls, size: int) -> Self:
        """Return a new state for a vector of `size` numbers, with zero moments."""
        return cls(np.zeros(size), np.zeros(size))

    def step(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the update for a gradient, with one learning rate per number."""
        self.steps += 1
        self.moment1 += (1 - BETA1) * (gradient - self.moment1)
        self.moment2 += (1 - BETA2) * (gradient**2 - self.moment2)
        unbiased1 = self.moment1 / (1 - BETA1**self.steps)
        unbiased2 = self._spread() / (1 - BETA2**self.steps)
        return np.asarray(-rates * unbiased1 / (np.sqrt(unbiased2) + EPSILON))

    def _spread(self) -> NDArray[np.float64]:
        """Return the second moment that steps are divided by."""
        return self.moment2


class VectorAmsgrad(VectorAdam):
    """AMSGrad (Reddi et al. 2018) for a small vector: Adam with the largest second moment so far."""

    _largest: NDArray[np.float64] | float = 0.0

    def _spread(self) -> NDArray[np.float64]:
        self._largest = np.maximum(self._largest, self.moment2)
        return self._largest
