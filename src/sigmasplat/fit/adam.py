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

    Rows out of view keep still. When one is seen again, its moments are first decayed by the steps it missed, as dense
    Adam's would have been. Left out is dense Adam's coasting meanwhile: at most β₁/(√β₂ − β₁) ≈ 9.1 times the row's
    last step in each column, however long it stays away (once the bias correction has worn off, some 1000 steps). The
    native kernels do the same, fused (native/adam.h).
    """
    rows = visible.nonzero().squeeze(1)
    age = (field.steps - field.last_step[rows])[:, None].to(grad)
    g = grad[rows]
    moment1 = field.moment1[rows] * BETA1**age + (1 - BETA1) * g
    moment2 = field.moment2[rows] * BETA2**age + (1 - BETA2) * g * g
    unbiased1, unbiased2 = moment1 / (1 - BETA1**field.steps), moment2 / (1 - BETA2**field.steps)
    field.params[rows] -= rates.per_column * unbiased1 / (unbiased2.sqrt() + EPSILON)
    field.moment1[rows], field.moment2[rows] = moment1, moment2
    field.last_step[rows] = field.steps


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
