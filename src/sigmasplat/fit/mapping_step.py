"""One mapping step on a view: the image terms' gradient on its planes, from there to the splats, and Adam's step."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates, adam_step
from sigmasplat.fit.target import Target
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render.channels import variance_of
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

Weights = Mapping[str, float]
SHAPE_TERMS = ("isotropy", "isotropy_ratio")
"""Terms of the splats, not of an image."""
COMPILED_TERMS = {"l1", "ssim", "depth", "nll_color", "nll_depth", "alignment", "moment", *SHAPE_TERMS}
"""What `CompiledImages` and `CompiledStep` know; any other term, but `nll_color_full`, needs a `TorchStep`."""


Twist = Matrix | Tensor
"""Of a pose [6]; a tensor may still be on its way from a device, as may a number be."""


def arrived(twists: Sequence[Twist], numbers: Sequence[float | Tensor]) -> tuple[list[Matrix], list[float]]:
    """Return twists and numbers as the host has them; it waits once for all that are on a device."""
    there = [x.double().reshape(-1) for x in (*twists, *numbers) if isinstance(x, Tensor)]
    found = torch.cat(there).cpu().numpy() if there else np.empty(0)
    parts = iter(np.split(found, np.cumsum([len(x) for x in there])))
    here = [next(parts) if isinstance(x, Tensor) else x for x in twists]
    return here, [float(next(parts)[0]) if isinstance(x, Tensor) else x for x in numbers]


def render_for(view: View, params: Tensor, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
    """Render rows to the view's planes, with what the terms that have weight need."""
    reference = target.depth_image if weights.get("moment") else None
    view.forward(params, T_camera_world, reference, layers=bool(weights.get("alignment")))


def shape_pull(log_scales: Tensor, weights: Weights, of_all: float, of_visible: float) -> tuple[Tensor, float]:
    """Return the pull of the weighted shape terms on some splats' log scales [n, 3], and what they cost.

    of_all, of_visible: share of these splats among all and among those in view, which each term is a mean over.
    """
    leaf, shares = log_scales.clone().requires_grad_(), dict(zip(SHAPE_TERMS, (of_all, of_visible), strict=True))
    cost = losses.total(
        {name: weights.get(name, 0.0) * share for name, share in shares.items()}, {"scales": leaf.exp()}
    )
    if not cost.requires_grad:
        return torch.zeros_like(log_scales), 0.0
    return torch.autograd.grad(cost, leaf)[0], float(cost.detach())


class Gathered:
    """The gradient of several images' mean loss by the splats that any of them shows."""

    def __init__(self, view: View, field: GaussianField) -> None:
        self._view = view
        self.grad, self._rows = torch.zeros_like(field.params), torch.zeros_like(field.params)
        self.visible = torch.zeros(len(field), dtype=torch.bool, device=field.params.device)

    def add(self, field: GaussianField, share: float, pull: Tensor | None = None) -> Matrix:
        """Add the view's gradient planes at their share of the mean; return the image's own pose twist [6]."""
        twist = self._view.backward(field.params, self._rows, pull)
        self.visible |= self._view.visible(len(field))
        self.grad += share * self._rows
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float:
        """Add the shape terms' pull, take Adam's step; return what those terms cost."""
        scales = COLUMNS["log_scales"]
        of_all = float(self.visible.sum()) / max(len(field), 1)
        pull, cost = shape_pull(field.params[self.visible][:, scales], weights, of_all, 1.0)
        rows = self.grad[self.visible]
        rows[:, scales] += pull
        self.grad[self.visible] = rows
        self.grad[:frozen_colors, COLUMNS["colors"]] = 0.0
        adam_step(field, self.grad, rates, self.visible)
        return cost


class TorchStep:
    """One mapping step by its definition: terms of `losses`, gradients by autograd, `adam_step`."""

    def __init__(self, view: View) -> None:
        self.view = view

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field to the view's planes."""
        render_for(self.view, field.params, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        v, (h, w) = self.view, target.depth_image.shape
        used = {n: x for n, x in weights.items() if n not in SHAPE_TERMS and (len(v.sums) >= 7 or "nll" not in n)}
        planes = {"sums": (v.sums, v.g_sums)}
        if used.get("moment"):
            planes["moment"] = v.moment, v.g_moment
        if used.get("alignment"):
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
        if len(v.sums) >= 7:
            maps["variance"] = variance_of(sums)
        loss = losses.total(used, maps)
        found = torch.autograd.grad(loss, list(leaves.values()), materialize_grads=True)
        for (_, gradient), value in zip(planes.values(), found, strict=True):
            gradient.copy_(value)
        return float(loss.detach())

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, pull: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Carry the planes to the splats in view, add the shape terms' pull on them, and step.

        Returns the pose twist [6] and what the shape terms cost. `pull` is filled as by `View.backward`.
        """
        gathered = Gathered(self.view, field)
        twist = gathered.add(field, 1.0, pull)
        return twist, gathered.step(field, rates, weights, frozen_colors)
