"""Splats on the image plane, the channels that are summed over them at each pixel, and what follows from the sums.

With `render.depth=ray` depth is linear within a splat: at a pixel it is z + slopes · (pixel − mean)
(`reference.depth_slopes`). The sum of these planes over splats is a plane per pixel, blended as three features.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from sigmasplat.data.camera import Camera

FRUSTUM_MARGIN = 0.15
"""The projection is linearised at most this share of the image size outside the image (3DGS's factor 1.3)."""
PLANES = 3


class Projection(NamedTuple):
    """Splats on the image plane. A culled splat (z ≤ near_m) has radii, means2d and conics 0, and gets no gradient."""

    means2d: Tensor
    """[N, 2] px."""
    conics: Tensor
    """[N, 3] (l1, l2, l3), upper Cholesky factor of the inverse 2D covariance, 1/px."""
    z: Tensor
    """[N] m."""
    radii: Tensor
    """[N, 2] standard deviations along u and v in px, detached."""


class Blended(NamedTuple):
    """Sums over splats at each pixel; w = α·T is the weight of a splat at a pixel."""

    sums: Tensor
    """[H, W, K] Σ w f."""
    moment: Tensor | None
    """[H, W] Σ w (z − ref)² in m², 0 where ref ≤ 0; None without ref."""
    alpha: Tensor
    """[H, W] Σ w, one minus the light that passes all splats."""
    median_id: Tensor
    """[H, W] int32, the splat at which the light falls from ≥ ½ to < ½; −1 = none."""
    median_weight: Tensor
    """[H, W] its w, detached; 0 = none."""
    dominant_id: Tensor
    """[H, W] int32, the splat of largest w, the nearest one if several are equal; −1 = none."""
    dominant_weight: Tensor
    """[H, W] its w, detached; 0 = none."""


def features_of(colors: Tensor, z: Tensor, variances: Tensor) -> Tensor:
    """Stack the channels of each splat: (r, g, b, z, σ² + c² ×3), [N, 7]."""
    return torch.cat([colors, z[:, None], variances + colors**2], 1)


def variance_of(sums: Tensor) -> Tensor:
    """Apply the law of total variance to features [H, W, 7]: V = E[σ² + c²] − E[c]² [H, W, 3] (VarSplat §1)."""
    return sums[..., 4:7] - sums[..., 0:3] ** 2


def plane_features(p: Projection, slopes: Tensor, camera: Camera) -> Tensor:
    """Return the plane of each splat [N, 3]: its depth at the centre of the image, m, and its slopes [N, 2], m/px."""
    at_center = p.z - (slopes * (p.means2d - _center(camera).to(slopes))).sum(1)
    return torch.cat([at_center[:, None], slopes], 1)


def depth_of(planes: Tensor, camera: Camera) -> Tensor:
    """Return the depth Σ w d [H, W], m, of blended planes [H, W, 3]."""
    return planes[..., 0] + (planes[..., 1:] * _offsets(camera).to(planes)).sum(-1)


def depth_at(rows: Tensor, p: Projection, slopes: Tensor, camera: Camera) -> Tensor:
    """Return the depth [H, W], m, of one splat at each pixel; rows [H, W] are indices of splats."""
    away = _offsets(camera).to(slopes) + _center(camera).to(slopes) - p.means2d[rows]
    return p.z[rows] + (slopes[rows] * away).sum(-1)


def _center(camera: Camera) -> Tensor:
    return torch.tensor([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0])


def _offsets(camera: Camera) -> Tensor:
    """Return pixel − centre of the image [H, W, 2]."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([u, v], -1) - _center(camera)
