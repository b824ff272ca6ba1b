"""One mapping step on a view: compute the gradient of the image terms, propagate it to the splats, take Adam's step."""

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates, adam_step
from sigmasplat.fit.fused_terms import SHAPE_TERMS
from sigmasplat.fit.interface import MappingStep, Weights
from sigmasplat.fit.target import Target
from sigmasplat.render.channels import variance_of
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def render_for(view: View, params: Tensor, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
    """Render rows into the view's planes, with the outputs that terms with a nonzero weight need."""
    reference = target.depth_image if weights.get("moment") else None
    view.forward(params, T_camera_world, reference, layers=bool(weights.get("median_depth")))


def shape_gradient(log_scales: Tensor, weights: Weights, of_all: float, of_visible: float) -> tuple[Tensor, float]:
    """Return the gradient of the weighted shape terms with respect to the log scales [n, 3] of some splats, and the
    cost.

    of_all, of_visible: the number of these splats relative to all splats and to those in view; each term is a mean over
    one of the two.
    """
    leaf, shares = log_scales.clone().requires_grad_(), dict(zip(SHAPE_TERMS, (of_all, of_visible), strict=True))
    cost = losses.total(
        {name: weights.get(name, 0.0) * share for name, share in shares.items()}, {"scales": leaf.exp()}
    )
    if not cost.requires_grad:
        return torch.zeros_like(log_scales), 0.0
    return torch.autograd.grad(cost, leaf)[0], float(cost.detach())


def image_gradients(view: View, target: Target, weights: Weights) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Return the loss of the image terms, and a list of the view's gradient planes with their gradients, by autograd.

    Terms of the splats are skipped, and so are terms of the variance if the view has none.
    """
    v, (h, w) = view, target.depth_image.shape
    used = {n: x for n, x in weights.items() if n not in SHAPE_TERMS and (len(v.sums) >= 7 or "nll" not in n)}
    planes = {"sums": (v.sums, v.g_sums)}
    if used.get("moment"):
        planes["moment"] = v.moment, v.g_moment
    if used.get("mean_depth"):
        planes["alpha"] = v.alpha, v.g_alpha
    if used.get("median_depth"):
        planes["median_depth"] = v.layers.median_depth, v.g_median_depth
    leaves = {name: values.detach().clone().requires_grad_() for name, (values, _) in planes.items()}
    sums = leaves["sums"][:, :h, :w].movedim(0, -1)
    maps: dict[str, Tensor] = {name: leaf[:h, :w] for name, leaf in leaves.items() if name != "sums"} | {
        "color": sums[..., :3],
        "depth": sums[..., 3],
        "color_target": target.image,
        "depth_target": target.depth_image,
        "valid": target.depth_image > 0,
    }
    if target.depth_weight is not None:
        maps["depth_weight"] = target.depth_weight[:h, :w]
    if len(v.sums) >= 7:
        maps["variance"] = variance_of(sums)
    loss = losses.total(used, maps)
    found = torch.autograd.grad(loss, list(leaves.values()), materialize_grads=True)
    return loss.detach(), [(plane, value) for (_, plane), value in zip(planes.values(), found, strict=True)]


class GradientAccumulator:
    """Sum of the gradient of several images' mean loss with respect to the splats visible in any of them."""

    def __init__(self, view: View, field: GaussianField) -> None:
        self._view = view
        self.grad, self._rows = torch.zeros_like(field.params), torch.zeros_like(field.params)
        self.visible = torch.zeros(len(field), dtype=torch.bool, device=field.params.device)

    def add(self, field: GaussianField, share: float, grad2d: Tensor | None = None) -> Matrix:
        """Add the view's gradient planes, weighted by their share of the mean. Return the image's own pose twist
        [6]."""
        twist = self._view.backward(field.params, self._rows, grad2d)
        self.visible |= self._view.visible(len(field))
        self.grad += share * self._rows
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float:
        """Add the gradient of the shape terms and take Adam's step. Return the cost of the shape terms."""
        scales = COLUMNS["log_scales"]
        of_all = float(self.visible.sum()) / max(len(field), 1)
        on_scales, cost = shape_gradient(field.params[self.visible][:, scales], weights, of_all, 1.0)
        rows = self.grad[self.visible]
        rows[:, scales] += on_scales
        self.grad[self.visible] = rows
        self.grad[:frozen_colors, COLUMNS["colors"]] = 0.0
        adam_step(field, self.grad, rates, self.visible)
        return cost


class TorchStep:
    """One mapping step in its defining form: terms of `losses`, gradients by autograd, `adam_step`."""

    def __init__(self, view: View) -> None:
        self.view = view
        view.g_alpha.zero_()  # only the term of mean depth writes it

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes."""
        render_for(self.view, field.params, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        loss, gradients = image_gradients(self.view, target, weights)
        for plane, gradient in gradients:
            plane.copy_(gradient)
        return float(loss)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Propagate the gradient planes to the splats in view, add the gradient of the shape terms, and step.

        Returns the pose twist [6] and the cost of the shape terms. grad2d [N] is filled as by `View.backward`.
        """
        accumulator = self.accumulator(field)
        twist = accumulator.add(field, 1.0, grad2d)
        return twist, accumulator.step(field, rates, weights, frozen_colors)

    def accumulator(self, field: GaussianField) -> GradientAccumulator:
        """Allocate the gradient sum of several images."""
        return GradientAccumulator(self.view, field)


class OwnTermsStep:
    """A device's fused step, together with the image terms that its kernels do not support, which autograd computes."""

    def __init__(self, fused: MappingStep, own: frozenset[str]) -> None:
        self._fused, self._own = fused, own
        self.view, self.forward, self.splats, self.accumulator = (
            fused.view, fused.forward, fused.splats, fused.accumulator,
        )  # fmt: skip

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        fused = self._fused.images(target, {n: w for n, w in weights.items() if n not in self._own})
        own, gradients = image_gradients(self.view, target, {n: w for n, w in weights.items() if n in self._own})
        for plane, gradient in gradients:
            plane.add_(gradient)
        return fused + own
