"""Step every splat by Adam (Kingma & Ba 2015), a learning rate per column of the field."""

from dataclasses import dataclass, field as dataclass_field

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


def adam_step(field: GaussianField, grad: Tensor, rates: Rates, step: int, compiled: bool) -> None:
    """Move `field.params` against grad [N, 17], in place; step counts from 1 and removes the moments' start-up bias.

    Unseen splats have gradient 0: their moments decay and they coast, exactly as in dense Adam.
    """
    if compiled:
        from sigmasplat.native import _core

        _core.adam(
            field.params, grad, field.moment1, field.moment2, rates.per_column.numpy(), BETA1, BETA2, EPSILON, step
        )
        return
    field.moment1.lerp_(grad, 1 - BETA1)
    field.moment2.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    unbiased1 = field.moment1 / (1 - BETA1**step)
    unbiased2 = field.moment2 / (1 - BETA2**step)
    field.params -= rates.per_column * unbiased1 / (unbiased2.sqrt() + EPSILON)


@dataclass(eq=False)
class TwistAdam:
    """Adam on one pose, in its tangent space: each step starts from the pose of the last."""

    moment1: NDArray[np.float64] = dataclass_field(default_factory=lambda: np.zeros(6))
    moment2: NDArray[np.float64] = dataclass_field(default_factory=lambda: np.zeros(6))
    steps: int = 0

    def step(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the twist update [6] (to be applied on the left of T_camera_world) for a gradient [6]."""
        self.steps += 1
        self.moment1 += (1 - BETA1) * (gradient - self.moment1)
        self.moment2 += (1 - BETA2) * (gradient**2 - self.moment2)
        unbiased1 = self.moment1 / (1 - BETA1**self.steps)
        unbiased2 = self.moment2 / (1 - BETA2**self.steps)
        return np.asarray(-rates * unbiased1 / (np.sqrt(unbiased2) + EPSILON))
