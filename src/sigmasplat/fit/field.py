"""fit_field: adjust the splats to keyframes, and the keyframes' poses too if asked. Mapping is this one function."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field as dataclass_field

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates, adam_step
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.model import se3
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render.render import variance_of
from sigmasplat.render.view import CpuView, View


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
    return {
        "l1": config.weight_l1,
        "ssim": config.weight_ssim,
        "depth": config.weight_depth,
        "nll_color": config.weight_nll_color,
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
) -> FieldFit:
    """Take one Adam step on the field per keyframe drawn, in the order given; the first `frozen_colors` keep theirs.

    Adam's moments live on from fit to fit. A new splat's start from zero while the bias correction has run out, so its
    first steps are a few times longer: it has farther to go.
    """
    fit, rates, weights = FieldFit(), rates or Rates.of(config), loss_weights(config)
    pose_rates = np.repeat([config.lr_pose_translation, config.lr_pose_rotation], 3)
    compiled = isinstance(view, CpuView)
    fused = compiled and {name for name, weight in weights.items() if weight} <= COMPILED_TERMS
    gradients = CompiledLoss(view) if fused else TorchLoss(view)
    grad = torch.zeros_like(field.params)
    for keyframe in keyframes:
        field.steps += 1
        t = time.perf_counter()
        view.forward(field.params, se3.inverse(keyframe.T_world_camera))
        t = fit.add("forward", t)
        loss = gradients.images(keyframe.target, weights)
        t = fit.add("loss", t)
        twist = view.backward(field.params, grad)
        if pose_rates.any() and not keyframe.fixed:
            keyframe.move(twist, pose_rates)
        t = fit.add("backward", t)
        loss += gradients.splats(field.params, grad, weights["isotropy"])
        grad[:frozen_colors, COLUMNS["colors"]] = 0.0
        adam_step(field, grad, rates, field.steps, compiled)
        fit.add("optimiser", t)
        fit.losses.append(loss)
    return fit


class TorchLoss:
    """The mapping loss by its definition: terms of `losses`, gradients by autograd."""

    def __init__(self, view: View) -> None:
        self.view = view

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
        if len(planes) == 7:
            maps["variance"] = variance_of(sums)
        used = {n: x for n, x in weights.items() if n != "isotropy" and (len(planes) == 7 or not n.startswith("nll"))}
        loss = losses.total(used, maps)
        (self.view.g_sums[:],) = torch.autograd.grad(loss, (planes,))
        return float(loss.detach())

    def splats(self, params: Tensor, grad: Tensor, weight: float) -> float:
        """Add the isotropy term's gradient to parameter rows; return the term, weighted."""
        leaf = params.detach().clone().requires_grad_()
        loss = weight * losses.isotropy(GaussianField(leaf).scales)
        grad += torch.autograd.grad(loss, (leaf,))[0]
        return float(loss.detach())


COMPILED_TERMS = {"l1", "ssim", "depth", "nll_color", "nll_depth", "isotropy"}
"""What `CompiledLoss` knows; with any other term in play the whole loss goes through `TorchLoss`."""


class CompiledLoss:
    """The same loss fused in the native kernels (tests hold it to `TorchLoss`)."""

    def __init__(self, view: View) -> None:
        from sigmasplat.native import _core

        self.core, self.view = _core, view
        camera = view.camera
        self.masked_color = torch.zeros_like(view.sums[:3])
        self.cache = torch.zeros(_core.ssim_cache_floats(camera.width, camera.height))
        self.masked_target = torch.zeros_like(self.masked_color)
        self.parts = np.zeros(4)

    def images(self, target: Target, weights: dict[str, float]) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        width, height = target.camera.width, target.camera.height
        local = [weights[name] for name in ("l1", "depth", "nll_color", "nll_depth")]
        self.core.mapping_losses(
            self.view.sums, target.color, target.depth, height, local, target.valid_pixels,
            self.view.g_sums, self.masked_color, self.parts,
        )  # fmt: skip
        if len(self.view.sums) < 7:
            local[2:] = [0.0, 0.0]
        loss = float(np.dot(local, self.parts))
        if weights["ssim"]:
            torch.mul(target.color, target.depth > 0, out=self.masked_target)
            self.core.ssim_target(self.masked_target, width, height, self.cache)
            similarity = self.core.ssim(
                self.masked_color, self.masked_target, self.cache, width, height, target.depth,
                -weights["ssim"], self.view.g_sums[:3],
            )  # fmt: skip
            loss += weights["ssim"] * (1.0 - similarity)
        return loss

    def splats(self, params: Tensor, grad: Tensor, weight: float) -> float:
        """Add the isotropy term's gradient to parameter rows; return the term, weighted."""
        return weight * self.core.isotropy(params, weight, grad) if weight else 0.0
