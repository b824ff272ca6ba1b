"""Blend values of splats beside their colours, and sum values of pixels over each splat, with the same weights.

The weight w_ip of splat i at pixel p is that of the render: Ĉ_p = Σ_i w_ip c_i.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.render.backend import backend_module, backend_name, options_on
from sigmasplat.render.kernels import Projection, depth_of, plane_features
from sigmasplat.render.render import colors_from

MEANS, QUATS = COLUMNS["means"], COLUMNS["quats"]
OWN = 6
"""Channels before the values: colour, depth, second moments of colour and of depth."""


@dataclass(frozen=True, eq=False)
class BlendedValues:
    """Sums over the splats of each pixel: color Σwc [H, W, 3], depth Σwz [H, W] m (z along the ray with
    `render.depth=ray`), second Σw(σ²+c²) [H, W] mean over the
    channels, values Σwv [H, W, K], alpha Σw [H, W]; rows [n]: the splats that can reach the image."""

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
    rows: Tensor
    _splats: int

    def moment_about(self, depth_m: Tensor) -> Tensor:
        """Return U = Σw(z − D)² ≥ 0 of the splats' centres about reference depths D [H, W] m (CG-SLAM eq. 10)."""
        off, depth = depth_m - self._center_m, self._center_depth - self.alpha * self._center_m
        return (self._depth_second - 2.0 * off * depth + off.square() * self.alpha).clamp(min=0.0)

    def gather(self, planes: Tensor) -> Tensor:
        """Return Σ_p w_ip g_p [N, k] of planes g [H, W, k] with k ≤ 6 + K; call it once, on a blend with `gather`.

        A pixel is linear in the values of its splats, so this is the gradient of the values if g is that of the image.
        """
        k = planes.shape[-1]
        total = (self._sums[..., :k] * planes).sum()  # given a gradient instead, torch would load sympy: half a second
        (found,) = torch.autograd.grad(total, self._features)
        return found.new_zeros(self._splats, k).index_copy_(0, self.rows, found[:, :k])


def reaching(p: Projection, camera: Camera, options: RenderConfig) -> Tensor:
    """Return the rows [n] of the splats that can reach the image, and possibly a few more."""
    reach = p.radii * (1.001 * math.sqrt(2.0 * math.log(1.0 / options.alpha_min))) + 1.0
    size = p.means2d.new_tensor([camera.width, camera.height])
    inside = (p.means2d + reach >= 0.0) & (p.means2d - reach <= size)
    return ((p.radii[:, 0] > 0) & inside.all(1)).nonzero().squeeze(1)


def blend_values(
    field: GaussianField,
    camera: Camera,
    T_camera_map: NDArray[np.floating],
    values: Tensor | Callable[[Tensor], Tensor],
    options: RenderConfig,
    backend: str,
    gather: bool = False,
) -> BlendedValues:
    """Blend values [N, K] of a field's splats at a pose (4×4), on the device that holds the field.

    values: all of them, or a function that returns those of some rows [n].

    Raises BackendError if the backend is not available.
    """
    kernels, T = backend_module(backend, field.params.device), torch.as_tensor(T_camera_map)
    name = backend_name(backend, field.params.device)
    options = options_on(name, options)
    with torch.no_grad():
        scales = field.params[:, COLUMNS["log_scales"]].contiguous().exp()  # contiguous: much faster
        whole = kernels.project(field.means, field.quats, scales, T, camera, options)
        rows = reaching(whole, camera, options)
        p, own = Projection(*(x[rows] for x in whole)), field.params[rows]
        variances = own[:, COLUMNS["log_variances"]].contiguous().exp()
        center_m = float(p.z.mean()) if len(rows) else 0.0  # keeps the squares small: float32 loses digits
        colors = colors_from(field, T, rows)
        second = (variances + colors.square()).mean(1)
        shared = torch.cat([colors, torch.stack([p.z, second, (p.z - center_m).square()], 1)], 1)
        features = torch.cat([shared, (values(rows) if callable(values) else values.to(p.z)[rows]).to(p.z)], 1)
        end = features.shape[1]
        if options.depth == "ray":
            slopes = kernels.depth_slopes(own[:, MEANS], own[:, QUATS], scales[rows], T, camera, options)
            features = torch.cat([features, plane_features(p, slopes, camera)], 1)
        opacities = own[:, 10].sigmoid()
    with torch.set_grad_enabled(gather):
        features.requires_grad_(gather)
        b = kernels.blend(*p, opacities, features, None, camera, options)
    sums = b.sums.detach()
    depth = depth_of(sums[..., end:], camera) if options.depth == "ray" else sums[..., 3]
    return BlendedValues(
        sums[..., :3], depth, sums[..., 4], sums[..., OWN:end], b.alpha.detach(), sums[..., 3], sums[..., 5],
        center_m, b.sums, features, rows, len(field),
    )  # fmt: skip
