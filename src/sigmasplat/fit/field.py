"""fit_field: adjust the splats to keyframes, and the keyframes' poses too if asked. Mapping is this one function."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field as dataclass_field
from itertools import repeat

import numpy as np
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.fit.adam import Rates, settle
from sigmasplat.fit.backends import gathering, step_for
from sigmasplat.fit.mapping_step import Twist, arrived
from sigmasplat.fit.target import Keyframe
from sigmasplat.model import se3
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


@dataclass
class FieldFit:
    """What a fit did: the loss of each iteration, and seconds spent by stage."""

    losses: list[float] = dataclass_field(default_factory=list)
    seconds: dict[str, float] = dataclass_field(default_factory=dict)

    def join(self, later: "FieldFit") -> None:
        """Take in what a later fit did."""
        self.losses += later.losses
        for stage, seconds in later.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    def add(self, stage: str, since: float) -> float:
        """Book the time since then under a stage; return now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now


def loss_weights(config: MappingConfig) -> dict[str, float]:
    """List the mapping loss as (term, weight): VarSplat §2, 0.8 L1 + 0.2 (1 − SSIM) + depth + L_reg + NLL; CG-SLAM
    eq. 18, with alignment, isotropy as a ratio, and U."""
    full = config.color_covariance == "full"
    return {
        "l1": config.weight_l1,
        "ssim": config.weight_ssim,
        "depth": config.weight_depth,
        "nll_color": 0.0 if full else config.weight_nll_color,
        "nll_color_full": config.weight_nll_color if full else 0.0,
        "nll_depth": config.weight_nll_depth,
        "isotropy": config.weight_isotropy,
        "isotropy_ratio": config.weight_isotropy_ratio,
        "alignment": config.weight_alignment,
        "moment": config.weight_moment,
    }


Felt = Callable[[Keyframe, Tensor], None]


def not_fixed(keyframe: Keyframe) -> bool:
    """Tell whether a keyframe's pose may move."""
    return not keyframe.fixed


def fit_field(
    field: GaussianField,
    view: View,
    batches: Iterable[Sequence[Keyframe]],
    config: MappingConfig,
    schedule: Iterable[Rates] | None = None,
    frozen_colors: int = 0,
    degree: int = 0,
    may_move: Callable[[Keyframe], bool] = not_fixed,
    felt: Felt | None = None,
) -> FieldFit:
    """Take one Adam step on the field per batch of keyframes, against their mean loss, in the order given.

    schedule: the rates of each step; by default those of the settings. The first `frozen_colors` splats keep their
    colours. degree: of view-dependent colour, fitted too if above 0. may_move: which keyframes' poses follow, at the
    settings' rates. felt: told how hard each splat's image mean was pulled [N] (3DGS), keyframe by keyframe.
    Adam's moments live on from fit to fit. A new splat's start from zero while the bias correction has run out, so its
    first steps are a few times longer: it has farther to go. Raises ConfigError where colour covariances or
    view-dependent colours are to be fitted to several keyframes at once.
    """
    if field.params.device != view.sums.device:
        return _fit_there(field, view, batches, config, schedule, frozen_colors, degree, may_move, felt)
    fit, rates = FieldFit(), Rates.of(config)
    pose_rates = np.repeat([config.lr_pose_translation, config.lr_pose_rotation], 3)
    steps = _Steps(field, view, loss_weights(config), frozen_colors, degree, felt)
    for batch, rates in zip(batches, schedule or repeat(rates), strict=False):  # noqa: B020 # the last ones settle the fit
        loss, twists = steps.take(batch, rates, fit)
        fit.losses.append(loss)
        for keyframe, twist in zip(batch, twists, strict=True):
            if pose_rates.any() and may_move(keyframe):
                keyframe.move(twist, pose_rates)
    settle(field, rates, compiled=isinstance(view, CpuView))
    for name, extra in field.extras.items():
        settle(extra, rates.of_extra(name), compiled=False)
    return fit


def _fit_there(
    field: GaussianField,
    view: View,
    batches: Iterable[Sequence[Keyframe]],
    config: MappingConfig,
    schedule: Iterable[Rates] | None,
    frozen_colors: int,
    degree: int,
    may_move: Callable[[Keyframe], bool],
    felt: Felt | None,
) -> FieldFit:
    """Fit on the view's device, and bring the field back to where it lies."""
    there, here = field.on(view.sums.device), field.params.device
    told = None if felt is None else lambda keyframe, pull: felt(keyframe, pull.to(here))
    fit = fit_field(there, view, batches, config, schedule, frozen_colors, degree, may_move, told)
    for name, extra in there.extras.items():
        field.carry(name).take(extra)
    field.take(there)
    return fit


class _Steps:
    """Adam's steps of one fit."""

    def __init__(
        self,
        field: GaussianField,
        view: View,
        weights: dict[str, float],
        frozen_colors: int,
        degree: int,
        felt: Felt | None,
    ) -> None:
        self.field, self.view, self.weights, self.frozen_colors, self.felt = field, view, weights, frozen_colors, felt
        field.moment1[:frozen_colors, COLUMNS["colors"]] = 0.0  # or they would coast on
        self.step = step_for(field, view, weights, degree)
        self.pull = None if felt is None else field.params.new_zeros(len(field))

    def take(self, batch: Sequence[Keyframe], rates: Rates, fit: FieldFit) -> tuple[float, list[Matrix]]:
        """Step against the mean loss of a batch; return that loss, and of each image its own pose twist [6]."""
        self.field.steps += 1
        gathered = gathering(self.step, self.field) if len(batch) > 1 else None
        costs, shape, twists = list[float | Tensor](), list[float | Tensor](), list[Twist]()
        for keyframe in batch:
            t, target = time.perf_counter(), keyframe.target.on(self.field.params.device)
            self.step.forward(self.field, se3.inverse(keyframe.T_world_camera), target, self.weights)
            t = fit.add("forward", t)
            costs.append(self.step.images(target, self.weights))
            t = fit.add("loss", t)
            if gathered is None:
                twist, cost = self.step.splats(self.field, rates, self.weights, self.frozen_colors, self.pull)
                shape.append(cost)
            else:
                twist = gathered.add(self.field, 1.0 / len(batch), self.pull)
            twists.append(twist)
            if self.felt is not None and self.pull is not None:
                self.felt(keyframe, self.pull)
            t = fit.add("backward", t)
        if gathered is not None:
            shape.append(gathered.step(self.field, rates, self.weights, self.frozen_colors))
        here, numbers = arrived(twists, [*costs, *shape])
        fit.add("backward", t)
        return sum(cost / len(batch) for cost in numbers[: len(costs)]) + sum(numbers[len(costs) :]), here
