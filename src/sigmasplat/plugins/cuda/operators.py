"""Call the CUDA kernels: `project` and `blend` as autograd operators in float32, as defined in `reference`.

NVRTC compiles the kernels at first use for the current device (plugins/cuda/cubins.py). torch provides memory, sorting
and the stream.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import (
    BackendError,
    Camera,
    RenderConfig,
    blend_with,
    pose_gradient,
    project_with,
    reference,
    view_params,
)
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.cubins import FEATURE_COUNTS
from sigmasplat.plugins.cuda.launch import blocks_for
from sigmasplat.plugins.cuda.raster import Planes, Raster

FEATURES_AT_ONCE = FEATURE_COUNTS[-1]


def _float32(name: str, value: Tensor, device: torch.device) -> Tensor:
    if value.dtype != torch.float32 or value.device != device:
        raise BackendError(
            f"the cuda backend takes float32 tensors on one device; {name} is {value.dtype} on {value.device}"
        )
    return value.detach().contiguous()


def _view(T: Tensor, camera: Camera, options: RenderConfig) -> tuple[NDArray[np.floating], Tensor | None]:
    """Return the kernels' `View` by value. If the pose is on a device, return it too, so that the host does not wait
    for it."""
    if T.device.type == "cpu":
        return view_params(camera, T.detach().double().numpy(), options), None
    return view_params(camera, np.eye(4), options), T.detach().float().contiguous()


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, T, camera, options):  # type: ignore[no-untyped-def]
        named = zip(("means", "quats", "scales"), (means, quats, scales), strict=True)
        m, q, s = (_float32(name, value, means.device) for name, value in named)
        ctx.launch, ctx.view, n = cuda_launch.launcher_for(m.device), _view(T, camera, options), len(m)
        means2d, conics, z, radii = m.new_empty(n, 2), m.new_empty(n, 3), m.new_empty(n), m.new_empty(n, 2)
        ctx.launch(
            FEATURE_COUNTS[0], "project_splats", blocks_for(n), *ctx.view, m, q, s, n, means2d, conics, z, radii
        )  # fmt: skip
        ctx.save_for_backward(m, q, s, radii, T)
        ctx.mark_non_differentiable(radii)
        return means2d, conics, z, radii

    @staticmethod
    def backward(ctx, g_means2d, g_conics, g_z, _):  # type: ignore[no-untyped-def]
        m, q, s, radii, T = ctx.saved_tensors
        g_m, g_q, g_s, n = torch.empty_like(m), torch.empty_like(q), torch.empty_like(s), len(m)
        twists = m.new_empty(blocks_for(n), 6, dtype=torch.float64)
        given = [g.contiguous() for g in (g_means2d, g_conics, g_z)]
        ctx.launch(
            FEATURE_COUNTS[0], "project_splats_backward", blocks_for(n), *ctx.view, m, q, s, radii, *given, n,
            g_m, g_q, g_s, twists,
        )  # fmt: skip
        return g_m, g_q, g_s, pose_gradient(T, twists.sum(0)) if ctx.needs_input_grad[3] else None, None, None


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, z, radii, opacities, features, ref_depth, camera, options):  # type: ignore[no-untyped-def]
        names = ("means2d", "conics", "z", "radii", "opacities", "features")
        given = (means2d, conics, z, radii, opacities, features)
        m, c, depth, r, o, f = (_float32(n, t, means2d.device) for n, t in zip(names, given, strict=True))
        n, k = f.shape
        ctx.raster = raster = Raster(cuda_launch.launcher_for(m.device), m.device)
        raster.prepare(n, k, camera, options)
        raster.each_splat("pack_given", m, c, depth, r, o, f, n, k, raster.frame, raster.packed)
        raster.bin()
        size = (camera.height, camera.width)
        ref = None if ref_depth is None else ref_depth.detach().to(depth).contiguous()
        moment = None if ref is None else raster.empty(*size)
        ids, weights = raster.empty(2, *size, dtype=torch.int32), raster.empty(2, *size)
        sums, alpha = raster.empty(k, *size), raster.empty(*size)
        planes = Planes(sums, moment, alpha, ids[0], weights[0], ids[1], weights[1])
        raster.blend(planes, ref)
        ctx.given, ctx.planes, ctx.ref = (c, depth, o), planes, ref
        detached = [ids[0], weights[0], ids[1], weights[1]]
        ctx.mark_non_differentiable(*detached)
        # The caller gets copies, because the backward pass reads the originals.
        maps = (sums.movedim(0, -1), moment, alpha)
        return (*(x.clone() if x is not None else None for x in maps), *detached)

    @staticmethod
    def backward(ctx, g_sums, g_moment, g_alpha, *_):  # type: ignore[no-untyped-def]
        raster, (conics, z, opacities) = ctx.raster, ctx.given
        on_moment = g_moment.contiguous() if g_moment is not None and ctx.ref is not None else None
        on_sums = g_sums.movedim(-1, 0).contiguous()
        sums, moment = raster.gradients(ctx.planes, ctx.ref, on_sums, on_moment, g_alpha.contiguous())
        n, k = raster.n, raster.used
        found = [raster.empty(n, 2), raster.empty(n, 3), raster.empty(n), raster.empty(n), raster.empty(n, k)]
        raster.each_splat(
            "chain_given", conics, z, opacities, raster.counts, sums, n, k, sums.shape[1], moment, *found
        )  # fmt: skip
        on_means2d, on_conics, on_z, on_opacities, on_features = found
        return on_means2d, on_conics, on_z, None, on_opacities, on_features, None, None, None


depth_slopes = reference.depth_slopes
project = project_with(_Project, reference.project)
blend = blend_with(_Blend, FEATURES_AT_ONCE, reference.blend)
