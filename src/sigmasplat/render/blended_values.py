"""Blend values of splats beside their colours, and sum values of pixels over each splat, with the same weights.

The weight w_ip of splat i at pixel p is that of the render: Ĉ_p = Σ_i w_ip c_i.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.render.backend import backend_module, backend_name, options_on
from sigmasplat.render.gated_depth import gated_depth
from sigmasplat.render.ray_depth import depth_of, plane_features
from sigmasplat.render.reference.operators import depth_slopes
from sigmasplat.render.render import colors_from

OWN = 6
"""Channels before the values: colour, depth, second moments of colour and of depth."""


@dataclass(frozen=True, eq=False)
class BlendedValues:
    """Sums over the splats of each pixel: color Σwc [H, W, 3], depth Σwz [H, W] m (z along the ray with
    `render.depth=ray`, behind the median gate with `render.depth_gate_m`), second Σw(σ²+c²) [H, W] mean over the
    channels, values Σwv [H, W, K], alpha Σw [H, W]."""

    color: Tensor
    depth: Tensor
    second: Tensor
    values: Tensor
    alpha: Tensor
    _center_depth: Tensor
    _depth_second: Tensor
    _center_m: float
    _sums: Tensor
    _features: Tensor

    def moment_about(self, depth_m: Tensor) -> Tensor:
        """Return U = Σw(z − D)² ≥ 0 of the splats' centres about reference depths D [H, W] m (CG-SLAM eq. 10)."""
        off, depth = depth_m - self._center_m, self._center_depth - self.alpha * self._center_m
        return (self._depth_second - 2.0 * off * depth + off.square() * self.alpha).clamp(min=0.0)

    def gather(self, planes: Tensor) -> Tensor:
        """Return Σ_p w_ip g_p [N, k] of planes g [H, W, k] with k ≤ 6 + K; call it once, on a blend with `gather`.

        A pixel is linear in the values of its splats, so this is the gradient of the values if g is that of the image.
        """
        k = planes.shape[-1]
        gradient = torch.zeros_like(self._sums)
        gradient[..., :k] = planes
        (found,) = torch.autograd.grad(self._sums, self._features, gradient)
        return found[:, :k]


def blend_values(
    field: GaussianField,
    camera: Camera,
    T_camera_map: NDArray[np.floating],
    values: Tensor,
    options: RenderConfig,
    backend: str,
    gather: bool = False,
) -> BlendedValues:
    """Blend values [N, K] of a field's splats at a pose (4×4), on the device that holds the field.

    Raises BackendError if the backend is not available.
    """
    kernels, T = backend_module(backend, field.params.device), torch.as_tensor(T_camera_map)
    name = backend_name(backend, field.params.device)
    options = options_on(name, options)
    with torch.no_grad():
        p = kernels.project(field.means, field.quats, field.scales, T, camera, options)
        seen_z = p.z[p.radii[:, 0] > 0]
        center_m = float(seen_z.mean()) if len(seen_z) else 0.0  # keeps the squares small: float32 loses digits
        colors = colors_from(field, T)
        second = (field.variances + colors.square()).mean(1)
        own = torch.cat([colors, torch.stack([p.z, second, (p.z - center_m).square()], 1)], 1)
        features = torch.cat([own, values.to(p.z)], 1)
        end = features.shape[1]
        if options.depth == "ray":
            slopes = depth_slopes(field.means, field.quats, field.scales, T, camera, options)
            features = torch.cat([features, plane_features(p, slopes, camera)], 1)
        opacities = field.opacities
    with torch.set_grad_enabled(gather):
        features.requires_grad_(gather)
        b = kernels.blend(*p, opacities, features, None, camera, options)
    sums = b.sums.detach()
    depth = depth_of(sums[..., end:], camera) if options.depth == "ray" else sums[..., 3]
    if options.depth_gate_m:
        depth = gated_depth(field.params.detach(), T, camera, options, name)
    return BlendedValues(
        sums[..., :3], depth, sums[..., 4], sums[..., OWN:end], b.alpha.detach(), sums[..., 3], sums[..., 5],
        center_m, b.sums, features,
    )  # fmt: skip
