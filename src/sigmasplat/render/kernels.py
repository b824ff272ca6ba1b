"""What the kernels of all devices share: parameters, operators made of autograd functions, the gradient of a pose."""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import ParamSpec

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.render.projection import FRUSTUM_MARGIN, Blended, Projection


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
