"""fit_field: adjust the splats to keyframes, and the keyframes' poses too if asked. Mapping is this one function."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field as dataclass_field
from itertools import repeat

import numpy as np
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.errors import ConfigError
from sigmasplat.fit.adam import Rates, settle
from sigmasplat.fit.color_covariance import CovarianceView, FullCovarianceStep
from sigmasplat.fit.cuda_step import CudaStep
from sigmasplat.fit.step import COMPILED_TERMS, CompiledImages, CompiledStep, Gathered, TorchStep
from sigmasplat.fit.target import Keyframe
from sigmasplat.fit.view_dependent import ViewDependentStep
from sigmasplat.model import se3
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render.cuda_view import CudaView
from sigmasplat.render.view import CpuView, Matrix, ReferenceView, View


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
        self.step = _step_for(field, view, weights, degree)
        self.pull = None if felt is None else field.params.new_zeros(len(field))

    def take(self, batch: Sequence[Keyframe], rates: Rates, fit: FieldFit) -> tuple[float, list[Matrix]]:
        """Step against the mean loss of a batch; return that loss, and of each image its own pose twist [6]."""
        self.field.steps += 1
        gathered = self._gathered(len(batch))
        loss, shape, twists = 0.0, 0.0, list[Matrix]()
        for keyframe in batch:
            t, target = time.perf_counter(), keyframe.target.on(self.field.params.device)
            self.step.forward(self.field, se3.inverse(keyframe.T_world_camera), target, self.weights)
            t = fit.add("forward", t)
            cost = self.step.images(target, self.weights)
            t = fit.add("loss", t)
            if gathered is None:
                twist, shape = self.step.splats(self.field, rates, self.weights, self.frozen_colors, self.pull)
            else:
                twist = gathered.add(self.view, self.field, 1.0 / len(batch), self.pull)
            twists.append(twist)
            loss += float(cost) / len(batch)  # read last: from a device it comes with the twist
            if self.felt is not None and self.pull is not None:
                self.felt(keyframe, self.pull)
            t = fit.add("backward", t)
        if gathered is not None:
            shape = gathered.step(self.field, rates, self.weights, self.frozen_colors)
            fit.add("backward", t)
        return loss + shape, twists

    def _gathered(self, images: int) -> Gathered | None:
        """Make room for the gradient of several images; None for one, whose step need not hold it."""
        if images == 1:
            return None
        if isinstance(self.step, FullCovarianceStep | ViewDependentStep):
            raise ConfigError("mapping.frames_per_step must be 1 with full colour covariance or view-dependent colour")
        return Gathered(self.field)


def _step_for(
    field: GaussianField, view: View, weights: dict[str, float], degree: int
) -> TorchStep | CompiledStep | CudaStep | FullCovarianceStep | ViewDependentStep:
    """Take the fused kernels where they know every term that has weight, else the definition.

    Raises ConfigError where full colour covariance meets terms that its view does not make maps for.
    """
    step: TorchStep | CompiledStep | FullCovarianceStep = TorchStep(view)
    if weights["nll_color_full"] and not isinstance(view, CpuView | ReferenceView):
        raise ConfigError(
            "mapping.color_covariance full is not made for CUDA; take --set backend=cpu or leave it diagonal"
        )
    compiled = {name for name, weight in weights.items() if weight} <= {*COMPILED_TERMS, "nll_color_full"}
    if weights["nll_color_full"] and isinstance(view, CpuView | ReferenceView):
        if weights["alignment"] or weights["moment"]:
            raise ConfigError(
                "mapping.color_covariance full goes without weight_alignment and weight_moment; set both to 0"
            )
        wide = CovarianceView(view, field.carry("correlations"))
        fused = compiled and isinstance(view, CpuView)
        step = FullCovarianceStep(wide, CompiledImages(wide) if fused else TorchStep(wide))
    elif compiled and isinstance(view, CpuView):
        step = CompiledStep(view)
    elif compiled and isinstance(view, CudaView) and not degree:
        return CudaStep(view)
    return ViewDependentStep(step, degree) if degree else step
