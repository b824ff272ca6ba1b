"""Depth along the ray (`render.depth=ray`): blend the plane of each splat, so that depth is linear within a splat.

A splat's depth at a pixel is z + slopes · (pixel − mean) (`reference.operators.depth_slopes`). The sum of these planes
over splats is a plane per pixel, blended as three features.
"""

import torch
from torch import Tensor

from sigmasplat.data.camera import Camera
from sigmasplat.render.reference.operators import Projection

PLANES = 3


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
