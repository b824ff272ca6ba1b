"""Fit view-dependent colours: one mapping step with spherical harmonics (VarSplat §7, refinement)."""

from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.data.harmonics import basis, count, view_colors
from sigmasplat.fit.adam import ROWS_AT_ONCE, Rates, adam_rows
from sigmasplat.fit.interface import Accumulator, Weights, one_image_only
from sigmasplat.fit.mapping_step import render_for, shape_gradient
from sigmasplat.fit.target import Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

COLORS, MEANS, SCALES = (COLUMNS[name] for name in ("colors", "means", "log_scales"))


class ImageStep(Protocol):
    """The part of the inner step that this step uses: its view, and the gradient of the image terms."""

    @property
    def view(self) -> View: ...

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        ...


class ViewDependentStep:
    """One mapping step of a field with view-dependent colours of degree 1 to 3.

    The view renders rows with the colours that this camera sees, and returns the gradient of these rows.
    """

    def __init__(self, base: ImageStep, degree: int) -> None:
        self.base, self.view, self.degree = base, base.view, degree
        self.width = 3 * count(degree)
        self.rows, self._R, self._position = torch.empty(0), torch.empty(0), torch.empty(0)

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes, with the colours seen from that pose."""
        self._R, t = (
            torch.as_tensor(part).to(field.params) for part in (T_camera_world[:3, :3], T_camera_world[:3, 3])
        )
        self._position = -(self._R * t[:, None]).sum(0)
        self.rows, harmonics = field.params.clone(), field.get_or_create("harmonics").params
        ahead = field.means @ self._R[2] + t[2] > 0
        for rows in torch.split(ahead.nonzero().squeeze(1), ROWS_AT_ONCE):
            own, k = field.params.index_select(0, rows), harmonics.index_select(0, rows)
            own[:, COLORS] = view_colors(own[:, COLORS], k, own[:, MEANS], self._position, self.degree)
            self.rows.index_copy_(0, rows, own)
        render_for(self.view, self.rows, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        return self.base.images(target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Step the splats in view and their harmonics, as `MappingStep.splats`."""
        grad, cost = torch.zeros_like(field.params), 0.0
        twist = self.view.backward(self.rows, grad, grad2d)
        harmonics = self._begin(field.get_or_create("harmonics"))
        harmonic_rates = Rates(rates.of_attribute("harmonics").per_column[: self.width], rates.beta2)
        visible = self.view.visible(len(field)).nonzero().squeeze(1)
        for rows in torch.split(visible, ROWS_AT_ONCE):
            g, own, k = (x.index_select(0, rows) for x in (grad, field.params, harmonics.params))
            g[rows < frozen_colors, COLORS] = 0.0
            g_harmonics, g_means = self._through_colors(own, k, g[:, COLORS])
            g_scales, term = shape_gradient(
                own[:, SCALES], weights, len(rows) / max(len(field), 1), len(rows) / max(len(visible), 1)
            )
            g[:, MEANS] += g_means
            g[:, SCALES] += g_scales
            twist[:3] += (self._R @ g_means.sum(0)).cpu().numpy()  # a camera motion ρ acts like a splat motion −ρ
            cost += term
            adam_rows(field, rows, g, rates)
            adam_rows(harmonics, rows, g_harmonics, harmonic_rates)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Raise ConfigError: this step takes one image only."""
        raise one_image_only()

    def _begin(self, harmonics: Rows) -> Rows:
        """Start a step of the harmonics; return the harmonics of the degrees in use, which share memory with the
        field's."""
        harmonics.steps += 1
        params, moment1, moment2 = (
            x[:, : self.width] for x in (harmonics.params, harmonics.moment1, harmonics.moment2)
        )
        return Rows(params, moment1, moment2, harmonics.last_step, harmonics.steps)

    def _through_colors(self, own: Tensor, harmonics: Tensor, g_shown: Tensor) -> tuple[Tensor, Tensor]:
        """Propagate the gradient of view-dependent colours [n, 3] to harmonics [n, width] and, by the direction, to
        means [n, 3]."""
        means = own[:, MEANS].clone().requires_grad_()
        values = basis(normalize(means - self._position, dim=1), self.degree)
        g_harmonics = values.detach()[:, :, None] * g_shown[:, None, :]
        g_values = (harmonics.reshape(-1, self.width // 3, 3) @ g_shown[:, :, None])[:, :, 0]
        (g_means,) = torch.autograd.grad(values, means, g_values)
        return g_harmonics.reshape(-1, self.width), g_means
