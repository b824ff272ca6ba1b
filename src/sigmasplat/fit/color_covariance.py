"""Fit the full colour covariance of splats: one mapping step.

This is an extension of the paper, which has one variance per channel. Tracking and all other code read only the
diagonal of V.
"""

from typing import Protocol

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit import losses
from sigmasplat.fit.adam import ROWS_AT_ONCE, Rates, adam_rows
from sigmasplat.fit.interface import Accumulator, Weights, one_image_only
from sigmasplat.fit.mapping_step import shape_gradient
from sigmasplat.fit.target import Target
from sigmasplat.render.channels import covariance_of
from sigmasplat.render.view import CorrelationView, View
from sigmasplat.types import Matrix

COLORS, SCALES = COLUMNS["colors"], COLUMNS["log_scales"]


class ImageTerms(Protocol):
    """The part of the inner step that this step uses: the gradient of the image terms."""

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of the image terms to the first seven gradient planes; return the loss."""
        ...


class FullCovarianceStep:
    """One mapping step with `nll_color_full` instead of `nll_color`; `others` computes the other terms on the same
    view.

    The gradient of V is propagated to everything that V depends on: variances, correlations, colours, and the weights
    of splats in a pixel.
    """

    def __init__(self, view: CorrelationView, others: ImageTerms) -> None:
        self._wide, self._others = view, others

    @property
    def view(self) -> View:
        """Return the view that the step renders to."""
        return self._wide

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes."""
        self._wide.forward(field.params, T_camera_world)

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        v, name = self._wide, "nll_color_full"
        loss = float(self._others.images(target, {**weights, name: 0.0}))
        v.g_sums[7:] = 0.0
        h, w = target.camera.height, target.camera.width
        color, second = (v.sums[part, :h, :w].detach().requires_grad_() for part in (slice(0, 3), slice(4, 10)))
        maps = {
            "color": color.movedim(0, -1),
            "color_target": target.image,
            "covariance": covariance_of(color.movedim(0, -1), second.movedim(0, -1)),
            "valid": target.depth_image > 0,
        }
        term = losses.total({name: weights[name]}, maps)
        g_color, g_second = torch.autograd.grad(term, (color, second))
        v.g_sums[:3, :h, :w] += g_color
        v.g_sums[4:10, :h, :w] += g_second
        return loss + float(term.detach())

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Step the splats in view and their correlations, as `MappingStep.splats`."""
        grad, cost = torch.zeros_like(field.params), 0.0
        twist = self._wide.backward(field.params, grad, grad2d)
        correlations, correlation_rates = self._wide.correlations, rates.of_attribute("correlations")
        correlations.steps += 1
        visible = self._wide.visible(len(field)).nonzero().squeeze(1)
        for rows in torch.split(visible, ROWS_AT_ONCE):
            g = grad[rows]
            g[rows < frozen_colors, COLORS] = 0.0
            shares = len(rows) / max(len(field), 1), len(rows) / max(len(visible), 1)
            g_scales, term = shape_gradient(field.params[rows][:, SCALES], weights, *shares)
            g[:, SCALES] += g_scales
            cost += term
            adam_rows(field, rows, g, rates)
            adam_rows(correlations, rows, self._wide.g_correlations[rows], correlation_rates)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Raise ConfigError: this step takes one image only."""
        raise one_image_only()
