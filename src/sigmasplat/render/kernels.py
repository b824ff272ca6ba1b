"""What the kernels of all devices take and return: splats on the image plane, the channels that are summed over them,
what follows from the sums; parameters, operators made of autograd functions, the gradient of a pose.

With `render.depth=ray` depth is linear within a splat: at a pixel it is z + slopes · (pixel − mean)
(`reference.depth_slopes`). The sum of these planes over splats is a plane per pixel, blended as three features.
"""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import NamedTuple, ParamSpec

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
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


def view_params(
    camera: Camera, T_camera_world: NDArray[np.floating], options: RenderConfig, dtype: type = np.float32
) -> NDArray[np.floating]:
    """Return camera, pose and switches as the kernels' `View` (native/splat.h)."""
    T = np.asarray(T_camera_world, np.float64)
    margin_u, margin_v = FRUSTUM_MARGIN * camera.width, FRUSTUM_MARGIN * camera.height
    limits = [
        -(camera.cx + margin_u) / camera.fx,
        (camera.width - camera.cx + margin_u) / camera.fx,
        -(camera.cy + margin_v) / camera.fy,
        (camera.height - camera.cy + margin_v) / camera.fy,
    ]
    switches = [True, options.covariance_pose_gradient, True]  # pose gradient through 2D mean, 2D covariance, depth
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *T[:3, :3].ravel(), *T[:3, 3]]
    numbers += [options.near_m, options.low_pass_px2, *limits, camera.width, camera.height, *map(float, switches)]
    return np.array(numbers, dtype)


Inputs = ParamSpec("Inputs")


def project_with(
    kernel: type[torch.autograd.Function], definition: Callable[Inputs, Projection]
) -> Callable[Inputs, Projection]:
    """Return a `project` that runs the kernel; the pose may be float64."""
    arguments = signature(definition)

    @wraps(definition)
    def project(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Projection:
        return Projection(*kernel.apply(*arguments.bind(*args, **kwargs).args))  # type: ignore[no-untyped-call]

    return project


def blend_with(
    kernel: type[torch.autograd.Function], features_at_once: int, definition: Callable[Inputs, Blended]
) -> Callable[Inputs, Blended]:
    """Return a `blend` of any number of features that runs the kernel once for every `features_at_once` of them.

    The first run makes every map; the other runs make only the sums of their features.
    """
    arguments = signature(definition)

    @wraps(definition)
    def blend(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Blended:
        *splats, features, ref_depth, camera, options = arguments.bind(*args, **kwargs).args
        groups = torch.split(features, features_at_once, dim=1)
        first = kernel.apply(*splats, groups[0], ref_depth, camera, options)  # type: ignore[no-untyped-call]
        more = [kernel.apply(*splats, g, None, camera, options)[0] for g in groups[1:]]  # type: ignore[no-untyped-call]
        return Blended(torch.cat([first[0], *more], -1) if more else first[0], *first[1:])

    return blend


def pose_gradient(T_camera_world: Tensor, twist: NDArray[np.float64] | Tensor) -> Tensor:
    """Return a left-twist gradient (ρ, φ) as a [4, 4] matrix gradient with the same value along every rigid motion.

    <G, [φ]× R | φ×t + ρ> = ρ·g_ρ + φ·g_φ for G = (½ [g_φ − t × g_ρ]× R | g_ρ). It is on the device of T_camera_world.
    """
    T = T_camera_world.detach().double()
    g = torch.as_tensor(twist).to(T)
    g_rho, g_phi = g[:3], g[3:]
    a = 0.5 * (g_phi - torch.linalg.cross(T[:3, 3], g_rho))
    turned = torch.linalg.cross(a[:, None].expand(3, 3), T[:3, :3], dim=0)  # [a]× R
    bottom = torch.zeros_like(T[:1])
    return torch.cat([torch.cat([turned, g_rho[:, None]], 1), bottom]).to(T_camera_world.dtype)


def twist_matrix(xi: Tensor) -> Tensor:
    """Return a twist (ρ, φ) [6], m and rad, as the matrix [4, 4] whose exponential is the motion."""
    zero = torch.zeros((), dtype=xi.dtype)
    x, y, z, a, b, c = xi
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero, zero, zero, zero]]
    return torch.stack([torch.stack(row) for row in rows])
