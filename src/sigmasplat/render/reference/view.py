"""A view with the definition in plain torch."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.config.sensors import SensorModel
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.render.channels import features_of
from sigmasplat.render.pose_gradient import twist_matrix
from sigmasplat.render.ray_depth import PLANES, depth_at, depth_of, plane_features
from sigmasplat.render.reference import operators as reference
from sigmasplat.render.view import Layers
from sigmasplat.types import Matrix


class ReferenceView:
    """A view with the definition in plain torch: slow, for tests and for machines without the compiled kernels."""

    backend = "reference"
    sensor: SensorModel | None = None

    def __init__(self, camera: Camera, options: RenderConfig, variance: bool = True) -> None:
        self.camera, self.options = camera, options
        self._k = 7 if variance else 4
        size = (camera.height, camera.width)
        self.sums, self.g_sums = torch.zeros(self._k, *size), torch.zeros(self._k, *size)
        self.alpha, self.g_alpha, self.moment = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self.layers, self.g_moment, self.g_median_depth = Layers.of(*size), torch.zeros(size), torch.zeros(size)
        self.seconds = np.zeros(5)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        """Render rows [N, 17] as `View.forward` does: planes [K, H, W], m and m²; nothing is padded."""
        self._leaf = params.detach().clone().requires_grad_()
        self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        T = torch.linalg.matrix_exp(twist_matrix(self._twist)) @ torch.as_tensor(T_camera_world)
        f = GaussianField(self._leaf)
        p = reference.project(f.means, f.quats, f.scales, T, self.camera, self.options)
        features = features_of(f.colors, p.z, f.variances)[:, : self._k]
        slopes = None
        if self.options.depth == "ray":
            slopes = reference.depth_slopes(f.means, f.quats, f.scales, T, self.camera, self.options)
            features = torch.cat([features, plane_features(p, slopes, self.camera)], 1)
        b = reference.blend(*p, f.opacities, features, depth_reference, self.camera, self.options, slopes)
        sums = b.sums
        if slopes is not None:
            depth = depth_of(sums[..., -PLANES:], self.camera)[..., None]
            sums = torch.cat([sums[..., :3], depth, sums[..., 4:-PLANES]], -1)
        self._maps, self._means2d = [(sums.movedim(-1, 0), self.g_sums), (b.alpha, self.g_alpha)], p.means2d
        self._visible = reaches(p, f.opacities.detach(), self.camera, self.options)
        self.sums.copy_(sums.detach().movedim(-1, 0))
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
            self._maps.append((b.moment, self.g_moment))
        if layers:
            self.layers.fill(b, p.z.detach())
            rows = b.median_id.clamp(min=0).long()
            nearest = p.z[rows] if len(f) else torch.zeros_like(b.alpha)
            if slopes is not None and len(f):
                nearest = depth_at(rows, p, slopes, self.camera)
            median_depth = torch.where(b.median_id >= 0, nearest, 0.0)
            self.layers.median_depth.copy_(median_depth.detach())
            self._maps.append((median_depth, self.g_median_depth))

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        """Write the gradient of the rows to g_params [N, 17], and grad2d [N] if given. Return the pose twist (ρ, φ)
        [6]."""
        maps, gradients = zip(*self._maps, strict=True)
        leaves = (self._leaf, self._twist, self._means2d)
        g_leaf, g_twist, g_means2d = torch.autograd.grad(maps, leaves, gradients, materialize_grads=True)
        g_params.copy_(g_leaf)
        if grad2d is not None:
            grad2d.copy_(grad2d_of(g_means2d, self.camera))
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        """Return the pose twist (ρ, φ) [6] from the gradient planes of colour and depth."""
        (g_twist,) = torch.autograd.grad(self._maps[0][0][:4], self._twist, self.g_sums[:4], materialize_grads=True)
        return np.asarray(g_twist.numpy(), np.float64)

    def visible(self, n: int) -> Tensor:
        """Return which splats of the last render reach the image, bool [n]."""
        return self._visible


def grad2d_of(g_means2d: Tensor, camera: Camera) -> Tensor:
    """Return the norm of image-mean gradients [N, 2] per px, converted to gradients per half image size, [N] (3DGS)."""
    half_image = g_means2d.new_tensor([camera.width / 2, camera.height / 2])
    return (g_means2d * half_image).square().sum(1).sqrt()


def reaches(p: reference.Projection, opacities: Tensor, camera: Camera, options: RenderConfig) -> Tensor:
    """Return which splats can change a view, bool [N]: those whose bounds of alpha ≥ alpha_min overlap the image."""
    reach = (2.0 * (opacities / options.alpha_min).log()).clamp(min=0.0).sqrt()[:, None] * p.radii.detach()
    low, high = p.means2d.detach() - reach, p.means2d.detach() + reach
    inside = ((high >= 0) & (low <= low.new_tensor([camera.width - 1.0, camera.height - 1.0]))).all(1)
    return inside & (p.radii[:, 0] > 0) & (opacities > options.alpha_min)
