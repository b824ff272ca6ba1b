"""See a field from a camera: two kernels, and algebra on what they gather (DESIGN §3)."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.render.backend import backend_module


@dataclass(frozen=True, eq=False)
class Render:
    """What a camera sees of a field, all [H, W] or [H, W, 3].

    color Ĉ = Σ w c; depth D̂ = Σ w z (m, not divided by alpha); alpha A = Σ w; variance V = Σ w (σ² + c²) − Ĉ², the law
    of total variance (VarSplat §1); uncertainty U = Σ w (z − D)² about a reference depth D (m², CG-SLAM eq. 10), None
    without one; median_depth: z where half the light is gone, 0 where it never is (CG-SLAM eq. 8); median_id,
    dominant_id: the splat of that depth, the splat of largest weight, −1 = none.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    variance: Tensor
    uncertainty: Tensor | None
    median_depth: Tensor
    median_id: Tensor
    dominant_id: Tensor
    dominant_weight: Tensor


def features_of(colors: Tensor, z: Tensor, variances: Tensor) -> Tensor:
    """Stack what a pixel gathers of each splat: (r, g, b, z, σ² + c² ×3), [N, 7]."""
    return torch.cat([colors, z[:, None], variances + colors**2], 1)


def variance_of(sums: Tensor) -> Tensor:
    """Apply the law of total variance to features [H, W, 7]: V = E[σ² + c²] − E[c]² [H, W, 3] (VarSplat §1)."""
    return sums[..., 4:7] - sums[..., 0:3] ** 2


def render(
    field: GaussianField,
    camera: Camera,
    T_camera_world: Tensor | NDArray[np.floating],
    depth_reference: Tensor | None = None,
    options: RenderConfig | None = None,
    backend: str = "auto",
) -> Render:
    """Render a field at a pose (4×4, world to camera); differentiable in `field.params` and in a tensor pose.

    Raises BackendError if the backend is not available.
    """
    kernels, options = backend_module(backend), options or RenderConfig()
    T = torch.as_tensor(T_camera_world)
    p = kernels.project(field.means, field.quats, field.scales, T, camera, options)
    features = features_of(field.colors, p.z, field.variances)
    b = kernels.blend(*p, field.opacities, features, depth_reference, camera, options)
    crossed = b.median_id >= 0
    nearest = p.z[b.median_id.clamp(min=0).long()] if len(field) else torch.zeros_like(b.alpha)
    return Render(
        b.sums[..., 0:3],
        b.sums[..., 3],
        b.alpha,
        variance_of(b.sums),
        b.moment,
        torch.where(crossed, nearest, 0.0),
        b.median_id,
        b.dominant_id,
        b.dominant_weight,
    )
