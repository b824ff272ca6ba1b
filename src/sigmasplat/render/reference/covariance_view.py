"""A view of ten planes instead of seven, for the full colour covariance, with the definition in plain torch."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS, Rows
from sigmasplat.render.channels import COVARIANCE_PLANES, covariance_features
from sigmasplat.render.pose_gradient import twist_matrix
from sigmasplat.render.reference import operators as reference
from sigmasplat.render.reference.view import grad2d_of, reaches
from sigmasplat.render.view import Layers, View
from sigmasplat.types import Matrix


class CovarianceView:
    """A view of ten planes (r, g, b, z, Σ + c cᵀ ×6), which also reads a field's `correlations`.

    It wraps a plain view of the same backend. `g_correlations` [N, 3] is the gradient of the last backward pass.
    """

    backend = "reference"
    _project = staticmethod(reference.project)

    def __init__(self, view: View, correlations: Rows) -> None:
        self.camera, self.options, self.sensor, self._plain = view.camera, view.options, view.sensor, view
        self.correlations, self.g_correlations = correlations, torch.empty(0)
        size = view.alpha.shape
        self.sums, self.g_sums = (view.sums.new_zeros(COVARIANCE_PLANES, *size) for _ in range(2))
        self.alpha, self.g_alpha, self.moment, self._depth = (view.sums.new_zeros(size) for _ in range(4))
        self.g_moment, self.g_median_depth = (view.sums.new_zeros(size) for _ in range(2))
        self.layers = Layers.of(size[0], size[1])

    @property
    def seconds(self) -> Matrix:
        """Return the seconds of the wrapped view."""
        return self._plain.seconds

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
        """Fill the planes."""
        self._blended = [x.detach().contiguous().requires_grad_() for x in self._splats]
        means2d, conics, z, opacities, features = self._blended
        depth = self._depth if with_moment else None
        b = reference.blend(means2d, conics, z, radii, opacities, features, depth, self.camera, self.options)
        self._maps = (b.sums.movedim(-1, 0), b.alpha)
        self.sums.copy_(self._maps[0].detach())
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
        if layers:
            self.layers.fill(b, z.detach())

    def _blend_backward(self, g_sums: Tensor, g_alpha: Tensor) -> tuple[Tensor, ...]:
        """Return the gradient of the blended splat values, in the order of `_splats`."""
        return torch.autograd.grad(self._maps, self._blended, (g_sums, g_alpha), materialize_grads=True)

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        *gradients, self.g_correlations, g_twist = self._carry(self.g_sums, self.g_alpha)
        if grad2d is not None:
            grad2d.copy_(grad2d_of(self._g_means2d, self.camera))
        for columns, gradient in zip(COLUMNS.values(), gradients, strict=True):
            g_params[:, columns] = gradient
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        g_sums = torch.zeros_like(self.g_sums)
        g_sums[:4] = self.g_sums[:4]
        return np.asarray(self._carry(g_sums, torch.zeros_like(self.alpha))[-1].numpy(), np.float64)

    def _carry(self, g_sums: Tensor, g_alpha: Tensor) -> tuple[Tensor, ...]:
        """Propagate gradient planes to the columns of the rows, the correlations and the twist."""
        g_blended = self._blend_backward(g_sums, g_alpha)
        self._g_means2d = g_blended[0]
        return torch.autograd.grad(self._splats, (*self._leaves, self._twist), g_blended, materialize_grads=True)

    def visible(self, n: int) -> Tensor:
        return self._visible
