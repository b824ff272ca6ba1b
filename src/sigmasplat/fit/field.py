"""fit_field: adjust the splats to keyframes, and the keyframes' poses too if asked. Mapping is this one function."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field as dataclass_field

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.fit import losses
from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, Rates, adam_step, settle
from sigmasplat.fit.color_covariance import CovarianceView, FullCovarianceStep
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.fit.view_dependent import ViewDependentStep
from sigmasplat.model import se3
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render.render import variance_of
from sigmasplat.render.view import CpuView, Matrix, ReferenceView, View


@dataclass
class FieldFit:
    """What a fit did: the loss of each iteration, and seconds spent by stage."""

    losses: list[float] = dataclass_field(default_factory=list)
    seconds: dict[str, float] = dataclass_field(default_factory=dict)

    def add(self, stage: str, since: float) -> float:
        """Book the time since then under a stage; return now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now


def loss_weights(config: MappingConfig) -> dict[str, float]:
    """List the mapping loss as (term, weight), VarSplat §2: 0.8 L1 + 0.2 (1 − SSIM) + depth + L_reg + NLL."""
    full = config.color_covariance == "full"
    return {
        "l1": config.weight_l1,
        "ssim": config.weight_ssim,
        "depth": config.weight_depth,
        "nll_color": 0.0 if full else config.weight_nll_color,
        "nll_color_full": config.weight_nll_color if full else 0.0,
        "nll_depth": config.weight_nll_depth,
        "isotropy": config.weight_isotropy,
    }


def fit_field(
    field: GaussianField,
    view: View,
    keyframes: Iterable[Keyframe],
    config: MappingConfig,
    rates: Rates | None = None,
    frozen_colors: int = 0,
    degree: int = 0,
) -> FieldFit:
    """Take one Adam step on the field per keyframe drawn, in the order given; the first `frozen_colors` keep theirs.

    degree: of view-dependent colour, fitted too if above 0. Adam's moments live on from fit to fit. A new splat's start
    from zero while the bias correction has run out, so its first steps are a few times longer: it has farther to go.
    """
    fit, rates, weights = FieldFit(), rates or Rates.of(config), loss_weights(config)
    pose_rates = np.repeat([config.lr_pose_translation, config.lr_pose_rotation], 3)
    step = _step_for(field, view, weights, degree)
    for keyframe in keyframes:
        field.steps += 1
        t = time.perf_counter()
        step.forward(field, se3.inverse(keyframe.T_world_camera))
        t = fit.add("forward", t)
        loss = step.images(keyframe.target, weights)
        t = fit.add("loss", t)
        twist, regulariser = step.splats(field, rates, weights["isotropy"], frozen_colors)
        if pose_rates.any() and not keyframe.fixed:
            keyframe.move(twist, pose_rates)
        fit.add("backward", t)
        fit.losses.append(loss + regulariser)
    settle(field, rates, compiled=isinstance(view, CpuView))
    for name, extra in field.extras.items():
        settle(extra, rates.of_extra(name), compiled=False)
    return fit


def _step_for(
    field: GaussianField, view: View, weights: dict[str, float], degree: int
) -> "TorchStep | CompiledStep | FullCovarianceStep | ViewDependentStep":
    """Take the fused kernels where they know every term that has weight, else the definition."""
    step: TorchStep | CompiledStep | FullCovarianceStep = TorchStep(view)
    compiled = {name for name, weight in weights.items() if weight} <= {*COMPILED_TERMS, "nll_color_full"}
    if weights["nll_color_full"] and isinstance(view, CpuView | ReferenceView):
        wide = CovarianceView(view, field.carry("correlations"))
        fused = compiled and isinstance(view, CpuView)
        step = FullCovarianceStep(wide, CompiledImages(wide) if fused else TorchStep(wide))
    elif compiled and isinstance(view, CpuView):
        step = CompiledStep(view)
    return ViewDependentStep(step, degree) if degree else step


class TorchStep:
    """One mapping step by its definition: terms of `losses`, gradients by autograd, `adam_step`."""

    def __init__(self, view: View) -> None:
        self.view = view

    def forward(self, field: GaussianField, T_camera_world: Matrix) -> None:
        """Render the field to the view's planes."""
        self.view.forward(field.params, T_camera_world)

    def images(self, target: Target, weights: dict[str, float]) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        h, w = target.camera.height, target.camera.width
        planes = self.view.sums.detach().clone().requires_grad_()
        sums = planes[:, :h, :w].movedim(0, -1)
        maps: dict[str, Tensor] = {
            "color": sums[..., :3],
            "depth": sums[..., 3],
            "color_target": target.image,
            "depth_target": target.depth_image,
            "valid": target.depth_image > 0,
        }
        if len(planes) >= 7:
            maps["variance"] = variance_of(sums)
        used = {n: x for n, x in weights.items() if n != "isotropy" and (len(planes) >= 7 or not n.startswith("nll"))}
        loss = losses.total(used, maps)
        (self.view.g_sums[:],) = torch.autograd.grad(loss, (planes,))
        return float(loss.detach())

    def splats(
        self, field: GaussianField, rates: Rates, weight_isotropy: float, frozen_colors: int
    ) -> tuple[Matrix, float]:
        """Carry the planes to the splats in view, add the isotropy term's pull on them, and step.

        Returns the pose twist [6] and what the splats in view add to the isotropy term, weighted.
        """
        grad, visible = torch.zeros_like(field.params), self.view.visible(len(field))
        twist = self.view.backward(field.params, grad)
        leaf = field.params.detach()[visible].requires_grad_()
        share = len(leaf) / max(len(field), 1)  # the term is a mean over all splats, in view or not
        regulariser = weight_isotropy * share * losses.isotropy(GaussianField(leaf).scales)
        grad[visible] += torch.autograd.grad(regulariser, (leaf,))[0]
        grad[:frozen_colors, COLUMNS["colors"]] = 0.0
        adam_step(field, grad, rates, visible)
        return twist, float(regulariser.detach())


COMPILED_TERMS = {"l1", "ssim", "depth", "nll_color", "nll_depth", "isotropy"}
"""What `CompiledImages` knows; with any other term in play, but `nll_color_full`, every step is a `TorchStep`."""


class CompiledImages:
    """The image terms fused in the native kernels, on a view's planes (r, g, b, z[, σ²+c² ×3])."""

    def __init__(self, planes: View) -> None:
        from sigmasplat.native import _core

        self.core, self.planes = _core, planes
        self.cache = torch.zeros(_core.ssim_cache_floats(planes.camera.width, planes.camera.height))
        self.parts = np.zeros(4)

    def images(self, target: Target, weights: dict[str, float]) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        width, height, sums, g_sums = target.camera.width, target.camera.height, self.planes.sums, self.planes.g_sums
        local = [weights[name] for name in ("l1", "depth", "nll_color", "nll_depth")]
        self.core.mapping_losses(
            sums, target.color, target.depth, height, local, target.valid_pixels, g_sums, self.parts
        )
        if len(sums) < 7:
            local[2:] = [0.0, 0.0]
        loss = float(np.dot(local, self.parts))
        if weights["ssim"]:
            self.core.ssim_target(target.color, target.depth, width, height, self.cache)
            similarity = self.core.ssim(
                sums[:3], target.color, self.cache, width, height, target.depth, -weights["ssim"], g_sums[:3]
            )
            loss += weights["ssim"] * (1.0 - similarity)
        return loss


class CompiledStep(CompiledImages):
    """The same step fused in the native kernels (tests hold it to `TorchStep`)."""

    def __init__(self, view: CpuView) -> None:
        super().__init__(view)
        self.view = view

    def forward(self, field: GaussianField, T_camera_world: Matrix) -> None:
        """Render the field to the view's planes."""
        self.view.forward(field.params, T_camera_world)

    def splats(
        self, field: GaussianField, rates: Rates, weight_isotropy: float, frozen_colors: int
    ) -> tuple[Matrix, float]:
        """Do what `TorchStep.splats` does in one pass, without a gradient row in memory."""
        twist, v = np.zeros(6), self.view
        isotropy = v.raster.step(
            field.params, field.moment1, field.moment2, field.last_step, v.sums, v.alpha, v.g_sums,
            rates.per_column.numpy(), BETA1, BETA2, EPSILON, field.steps, weight_isotropy, frozen_colors,
            twist, v.seconds[3:],
        )  # fmt: skip
        return twist, weight_isotropy * isotropy
