"""Fit how the colour channels of a splat vary together: one mapping step under the full colour covariance.

Beyond the paper, which has one variance a channel. Tracking and all else that reads V go on reading its diagonal.
"""

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sigmasplat.fit import losses
from sigmasplat.fit.adam import ROWS_AT_ONCE, Rates, adam_rows
from sigmasplat.fit.step import Weights, shape_pull
from sigmasplat.fit.target import Target
from sigmasplat.model.field import COLUMNS, GaussianField, Rows
from sigmasplat.render import reference
from sigmasplat.render.render import covariance_features, covariance_of
from sigmasplat.render.view import (
    NO_LAYERS,
    CpuView,
    Layers,
    Matrix,
    ReferenceView,
    View,
    pull_of,
    reaches,
    twist_matrix,
)

COLORS, SCALES = COLUMNS["colors"], COLUMNS["log_scales"]
PLANES, SLOTS = 10, 11
"""(r, g, b, z, Σ + c cᵀ ×6), and the next number of planes that the kernels are compiled for."""


class CovarianceView:
    """A view of ten planes instead of seven, which sees a field's `correlations` besides the rows it is given.

    Made of the two operators of the kernel seam, on the backend of the view it stands for; `g_correlations` [N, 3] is
    the gradient of the last backward pass.
    """

    def __init__(self, view: CpuView | ReferenceView, correlations: Rows) -> None:
        self.camera, self.options, self.seconds = view.camera, view.options, view.seconds
        self.correlations, self.g_correlations = correlations, torch.empty(0)
        self._project, self._raster = reference.project, None
        if isinstance(view, CpuView):
            from sigmasplat.native import _core
            from sigmasplat.render import cpu

            self._project, self._raster = cpu.project, _core.Rasteriser()
        size = view.alpha.shape
        self._slots = view.sums.new_zeros(SLOTS, *size)
        self.sums, self.g_sums = self._slots[:PLANES], view.sums.new_zeros(PLANES, *size)
        self.alpha, self.g_alpha, self.moment, self._depth = (view.sums.new_zeros(size) for _ in range(4))
        self.g_moment, self.g_median_depth = (view.sums.new_zeros(size) for _ in range(2))
        self.layers = Layers.of(*size)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        parts = [params[:, columns] for columns in COLUMNS.values()]
        self._leaves = [x.detach().contiguous().requires_grad_() for x in (*parts, self.correlations.params)]
        means, quats, log_scales, logits, colors, log_variances, correlations = self._leaves
        self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        T = torch.linalg.matrix_exp(twist_matrix(self._twist)) @ torch.as_tensor(T_camera_world)
        p = self._project(means, quats, log_scales.exp(), T, self.camera, self.options)
        opacities = torch.sigmoid(logits[:, 0])
        features = covariance_features(colors, p.z, log_variances.exp(), correlations)
        self._splats = (p.means2d, p.conics, p.z, opacities, features)
        self._visible = reaches(p, opacities.detach(), self.camera, self.options)
        if depth_reference is not None:
            self._depth[: self.camera.height, : self.camera.width] = depth_reference
        self._blend(p.radii, depth_reference is not None, layers)

    def _blend(self, radii: Tensor, with_moment: bool, layers: bool) -> None:
        """Fill the planes; the kernels write them as they are."""
        camera, o = self.camera, self.options
        self._blended = [x.detach().contiguous().requires_grad_(self._raster is None) for x in self._splats]
        means2d, conics, z, opacities, features = self._blended
        depth, moment = (self._depth, self.moment) if with_moment else (None, None)
        if self._raster is not None:
            planes = self.layers if layers else NO_LAYERS
            self._raster.blend_forward(
                means2d, conics, z, radii, opacities, features, camera.width, camera.height, o.alpha_min,
                o.transmittance_stop, depth, self._slots, moment, self.alpha, *planes[:4],
            )  # fmt: skip
            if layers:
                self.layers.fill_depth(z.detach())
            return
        b = reference.blend(means2d, conics, z, radii, opacities, features, depth, camera, o)
        self._maps = (b.sums.movedim(-1, 0), b.alpha)
        self.sums.copy_(self._maps[0].detach())
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
        if layers:
            self.layers.fill(b, z.detach())

    def backward(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Matrix:
        *gradients, self.g_correlations, g_twist = self._carry(self.g_sums, self.g_alpha)
        if pull is not None:
            pull.copy_(pull_of(self._g_means2d, self.camera))
        for columns, gradient in zip(COLUMNS.values(), gradients, strict=True):
            g_params[:, columns] = gradient
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        g_sums = torch.zeros_like(self.g_sums)
        g_sums[:4] = self.g_sums[:4]
        return np.asarray(self._carry(g_sums, torch.zeros_like(self.alpha))[-1].numpy(), np.float64)

    def _carry(self, g_sums: Tensor, g_alpha: Tensor) -> tuple[Tensor, ...]:
        """Carry gradient planes to the columns of the rows, the correlations and the twist."""
        if self._raster is None:
            g_blended = torch.autograd.grad(self._maps, self._blended, (g_sums, g_alpha), materialize_grads=True)
        else:
            g_blended = tuple(torch.empty_like(x) for x in self._blended)
            g_slots = torch.cat([g_sums, torch.zeros_like(g_sums[:1])])
            self._raster.blend_backward(self._slots, None, self.alpha, g_slots, None, g_alpha, *g_blended)
        self._g_means2d = g_blended[0]
        return torch.autograd.grad(self._splats, (*self._leaves, self._twist), g_blended, materialize_grads=True)

    def visible(self, n: int) -> Tensor:
        return self._visible


class ImageTerms(Protocol):
    """What is needed of another step: the gradient of the image terms that it knows."""

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of the image terms to the first seven gradient planes; return the loss."""
        ...


class FullCovarianceStep:
    """One mapping step with `nll_color_full` in place of `nll_color`; `others` does the other terms on the same view.

    V's gradient reaches what the diagonal's does, all that V is made of: variances, correlations, colours, and the
    weights of splats in a pixel.
    """

    def __init__(self, view: CovarianceView, others: ImageTerms) -> None:
        self._wide, self._others = view, others

    @property
    def view(self) -> View:
        """Return the view it renders to."""
        return self._wide

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field to the view's planes."""
        self._wide.forward(field.params, T_camera_world)

    def images(self, target: Target, weights: Weights) -> float:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        v, name = self._wide, "nll_color_full"
        loss = self._others.images(target, {**weights, name: 0.0})
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
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, pull: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Carry the planes to the splats in view, add the shape terms' pull on them, and step, correlations too.

        Returns the pose twist [6] and what the shape terms cost. `pull` is filled as by `View.backward`.
        """
        grad, cost = torch.zeros_like(field.params), 0.0
        twist = self._wide.backward(field.params, grad, pull)
        correlations, correlation_rates = self._wide.correlations, rates.of_extra("correlations")
        correlations.steps += 1
        visible = self._wide.visible(len(field)).nonzero().squeeze(1)
        for rows in torch.split(visible, ROWS_AT_ONCE):
            g = grad[rows]
            g[rows < frozen_colors, COLORS] = 0.0
            shares = len(rows) / len(field), len(rows) / len(visible)
            g_scales, term = shape_pull(field.params[rows][:, SCALES], weights, *shares)
            g[:, SCALES] += g_scales
            cost += term
            adam_rows(field, rows, g, rates)
            adam_rows(correlations, rows, self._wide.g_correlations[rows], correlation_rates)
        return twist, cost
