"""Fit splats to keyframes, and optionally the keyframes' poses: `fit_field` is all of mapping's optimisation."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field as dataclass_field
from itertools import repeat

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.errors import BackendError
from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates, settle
from sigmasplat.fit.backends import fits_of, step_for
from sigmasplat.fit.interface import Twist
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, Stopwatch, Task, at_once


@dataclass(eq=False)
class DensifyStats:
    """Gradient of one keyframe's loss with respect to the image means of N splats (3DGS): the sum of its norms over
    steps [N], and the number of steps in which each splat was visible [N]. Invalid after rows are removed or added."""

    keyframe: Keyframe
    grad2d: Tensor
    times: Tensor

    @staticmethod
    def of(keyframe: Keyframe, n: int, device: torch.device | None = None) -> "DensifyStats":
        """Make statistics of n splats, all 0, on a device (default: host memory)."""
        return DensifyStats(keyframe, torch.zeros(n, device=device), torch.zeros(n, device=device))

    def on_gradient(self, keyframe: Keyframe, grad2d: Tensor) -> None:
        """Add the norms [N] of one step, 0 for an invisible splat. Norms of other keyframes are ignored."""
        if keyframe is self.keyframe:
            self.grad2d += grad2d
            self.times += grad2d > 0


@dataclass(eq=False)
class FieldFit(Stopwatch):
    """The result of a fit: the loss of each iteration, and the seconds of each stage: forward, loss, backward."""

    losses: list[float] = dataclass_field(default_factory=list)

    def join(self, later: "FieldFit") -> None:
        """Append a later fit's losses and add its seconds."""
        self.losses += later.losses
        self.add(later.seconds)


def loss_weights(config: MappingConfig) -> dict[str, float]:
    """Return the terms of the mapping loss with their weights.

    VarSplat §2: 0.8 L1 + 0.2 (1 − SSIM) + depth + L_reg + NLL. CG-SLAM eq. 18: with median depth (`weight_alignment`),
    isotropy as a ratio, and U. The weight of any other term is `weight_<term>`; 0 if the settings have no such field.
    """
    names = {term: term for term in losses.TERMS} | {"median_depth": "alignment"}
    return {term: getattr(config, f"weight_{name}", 0.0) for term, name in names.items()}


def fitting(
    field: GaussianField, view: View, batches: Iterable[Sequence[Keyframe]], config: MappingConfig,
    schedule: Iterable[Rates] | None = None, frozen_colors: int = 0, degree: int = 0, stats: DensifyStats | None = None,
) -> Task[FieldFit]:  # fmt: skip
    """Take one Adam step on the field for each batch of keyframes, in the given order, with the mean loss of the batch.
    A slice is one step.

    schedule: the learning rates of each step, by default those of the settings. frozen_colors: the first splats that
    keep their colours. degree: degree of view-dependent colour; 0 = none. stats: receives the gradient with respect to
    each splat's image mean, per keyframe. Poses of keyframes that are `movable` and not `fixed` are fitted too, with
    the rates of the settings.

    Adam's moments continue from fit to fit. The moments of a new splat start at zero, but the bias correction has
    already faded. Its first steps are therefore a few times longer, which is useful because a new splat is far from its
    optimum.

    Raises BackendError if the field is not on the view's device; ConfigError if colour covariances or view-dependent
    colours are to be fitted to several keyframes at once.
    """
    if field.params.device != view.sums.device:
        where = f"the field is on {field.params.device}, the view on {view.sums.device}"
        raise BackendError(f"{where}; bring the field to the view's device with GaussianField.to")
    fit, rates = FieldFit(), Rates.of(config)
    pose_rates = np.repeat([config.lr_pose_translation, config.lr_pose_rotation], 3)
    steps = _Steps(field, view, loss_weights(config), frozen_colors, degree, stats)
    for batch, rates in zip(batches, schedule or repeat(rates), strict=False):  # noqa: B020 # the last ones settle the fit
        loss, twists = steps.take(batch, rates, fit)
        fit.losses.append(loss)
        for keyframe, twist in zip(batch, twists, strict=True):
            if pose_rates.any() and keyframe.movable and not keyframe.fixed:
                keyframe.move(twist, pose_rates)
        yield
    fits_of(view).settle(field, rates)
    for name, attribute in field.attributes.items():
        settle(attribute, rates.of_attribute(name))
    return fit


fit_field = at_once(fitting)
"""Fit as `fitting` does, in one go."""


class _Steps:
    """Adam's steps of one fit."""

    def __init__(
        self, field: GaussianField, view: View, weights: dict[str, float], frozen_colors: int, degree: int,
        stats: DensifyStats | None,
    ) -> None:  # fmt: skip
        self.field, self.weights, self.frozen_colors, self.stats = field, weights, frozen_colors, stats
        field.moment1[:frozen_colors, COLUMNS["colors"]] = 0.0  # otherwise Adam would keep moving them
        self.step, self.to_host = step_for(view, weights, degree), fits_of(view).to_host
        self.grad2d = None if stats is None else field.params.new_zeros(len(field))

    def take(self, batch: Sequence[Keyframe], rates: Rates, stopwatch: Stopwatch) -> tuple[float, list[Matrix]]:
        """Step with the mean loss of a batch. Return that loss, and the pose twist [6] of each image."""
        self.field.steps += 1
        accumulator = self.step.accumulator(self.field) if len(batch) > 1 else None
        costs, shape, twists = list[float | Tensor](), list[float | Tensor](), list[Twist]()
        for keyframe in batch:
            with stopwatch.stage("forward"):
                target = keyframe.target.to(self.field.params.device)
                self.step.forward(self.field, se3.inverse(keyframe.T_world_camera), target, self.weights)
            with stopwatch.stage("loss"):
                costs.append(self.step.images(target, self.weights))
            with stopwatch.stage("backward"):
                if accumulator is None:
                    twist, cost = self.step.splats(self.field, rates, self.weights, self.frozen_colors, self.grad2d)
                    shape.append(cost)
                else:
                    twist = accumulator.add(self.field, 1.0 / len(batch), self.grad2d)
                twists.append(twist)
                if self.stats is not None and self.grad2d is not None:
                    self.stats.on_gradient(keyframe, self.grad2d)
        with stopwatch.stage("backward"):
            if accumulator is not None:
                shape.append(accumulator.step(self.field, rates, self.weights, self.frozen_colors))
            on_host, numbers = self.to_host(twists, [*costs, *shape])
        return sum(cost / len(batch) for cost in numbers[: len(costs)]) + sum(numbers[len(costs) :]), on_host
