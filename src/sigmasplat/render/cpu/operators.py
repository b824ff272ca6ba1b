"""Call the compiled kernels: `project` and `blend` as autograd operators in float32, as defined in `reference`."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat import env
from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.errors import BackendError
from sigmasplat.native import _core
from sigmasplat.render.kernel_operators import blend_with, project_with
from sigmasplat.render.kernel_params import view_params
from sigmasplat.render.pose_gradient import pose_gradient
from sigmasplat.render.reference import operators as reference

FEATURES_AT_ONCE = 16


def apply_switches(asked: env.Switches) -> None:
    """Set the kernels' instruction set and threads.

    Raises BackendError if the requested instruction set is not supported.
    """
    offered = _core.supported_isas()
    if asked.isa not in ("auto", *offered):
        raise BackendError(
            f"SIGMASPLAT_ISA is {asked.isa!r}, which this machine cannot run; unset it or give {', '.join(offered)}"
        )
    _core.set_isa(asked.isa)
    if asked.threads:
        _core.set_threads(asked.threads)


apply_switches(env.switches())


def feature_slots(k: int) -> int:
    """Return how many feature planes a blend of k features writes: the next count the kernels are compiled for."""
    return next(slots for slots in (4, 7, 11, 16) if slots >= k)


def padded_size(camera: Camera) -> tuple[int, int]:
    """Return (rows, columns) of an image plane padded to whole tiles of the active instruction set."""
    tile_width, tile_height = _core.tile_size()
    return -(-camera.height // tile_height) * tile_height, -(-camera.width // tile_width) * tile_width


def _float32(name: str, value: Tensor) -> Tensor:
    if value.dtype != torch.float32 or value.device.type != "cpu":
        raise BackendError(
            f"the cpu backend takes float32 tensors on the CPU; {name} is {value.dtype} on {value.device}"
        )
    return value.detach().contiguous()


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, T, camera, options):  # type: ignore[no-untyped-def]
        m, q, s = _float32("means", means), _float32("quats", quats), _float32("scales", scales)
        view = view_params(camera, T.detach().double().numpy(), options)
        n = len(m)
        means2d, conics, z, radii = m.new_empty(n, 2), m.new_empty(n, 3), m.new_empty(n), m.new_empty(n, 2)
        _core.project_forward(view, m, q, s, means2d, conics, z, radii, None)
        seen = radii[:, :1] > 0
        means2d, conics = torch.where(seen, means2d, 0.0), torch.where(seen, conics, 0.0)
        ctx.save_for_backward(m, q, s, radii, T)
        ctx.view = view
        ctx.mark_non_differentiable(radii)
        return means2d, conics, z, radii

    @staticmethod
    def backward(ctx, g_means2d, g_conics, g_z, _):  # type: ignore[no-untyped-def]
        m, q, s, radii, T = ctx.saved_tensors
        g_m, g_q, g_s, twist = torch.empty_like(m), torch.empty_like(q), torch.empty_like(s), np.zeros(6)
        given = [g.contiguous() for g in (g_means2d, g_conics, g_z)]
        _core.project_backward(ctx.view, m, q, s, radii, given[0], given[1], given[2], g_m, g_q, g_s, twist)
        return g_m, g_q, g_s, pose_gradient(T, twist), None, None


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, z, radii, opacities, features, ref_depth, camera, options):  # type: ignore[no-untyped-def]
        names = ("means2d", "conics", "z", "radii", "opacities", "features")
        given = (means2d, conics, z, radii, opacities, features)
        m, c, depth, r, o, f = inputs = [_float32(n, t) for n, t in zip(names, given, strict=True)]
        rows, columns = padded_size(camera)
        k = features.shape[1]
        sums = torch.empty(feature_slots(k), rows, columns)
        alpha, weights = torch.empty(rows, columns), torch.empty(2, rows, columns)
        ids = torch.empty(2, rows, columns, dtype=torch.int32)
        moment = ref = None
        if ref_depth is not None:
            moment, ref = torch.empty(rows, columns), torch.zeros(rows, columns)
            ref[: camera.height, : camera.width] = ref_depth
        raster = _core.Rasteriser()
        raster.blend_forward(
            m, c, depth, r, o, f, camera.width, camera.height, options.alpha_min, options.transmittance_stop, ref,
            sums, moment, alpha, ids[0], weights[0], ids[1], weights[1],
        )  # fmt: skip
        ctx.raster, ctx.ref, ctx.shapes = raster, ref, [t.shape for t in inputs]
        ctx.size, ctx.padded, ctx.k = (camera.height, camera.width), sums.shape, k
        h, w = ctx.size
        maps = [sums[:k, :h, :w].permute(1, 2, 0), moment[:h, :w] if moment is not None else None, alpha[:h, :w]]
        detached = [ids[0][:h, :w], weights[0][:h, :w], ids[1][:h, :w], weights[1][:h, :w]]
        ctx.mark_non_differentiable(*detached)
        return (*(m.clone() if m is not None else None for m in maps), *detached)

    @staticmethod
    def backward(ctx, g_sums, g_moment, g_alpha, *_):  # type: ignore[no-untyped-def]
        h, w = ctx.size
        on_sums, on_alpha = torch.zeros(ctx.padded), torch.zeros(ctx.padded[1:])
        on_moment = None if ctx.ref is None else torch.zeros_like(on_alpha)
        on_sums[: ctx.k, :h, :w] = g_sums.permute(2, 0, 1)
        if not any(ctx.needs_input_grad[:5]):  # only the features: their gradient does not need that of the alphas
            g_features = torch.empty(ctx.shapes[5])
            ctx.raster.gather(on_sums, g_features)
            return None, None, None, None, None, g_features, None, None, None
        on_alpha[:h, :w] = g_alpha
        if on_moment is not None and g_moment is not None:
            on_moment[:h, :w] = g_moment
        m, c, z, _radii, o, f = (torch.zeros(s) for s in ctx.shapes)
        ctx.raster.blend_backward(on_sums, on_moment, on_alpha, m, c, z, o, f)
        return m, c, z, None, o, f, None, None, None


def depth_slopes(
    means: Tensor, quats: Tensor, scales: Tensor, T_camera_world: Tensor, camera: Camera, options: RenderConfig
) -> Tensor:
    """Return the slopes of `reference.depth_slopes`, without a gradient."""
    m, q, s = _float32("means", means), _float32("quats", quats), _float32("scales", scales)
    view, n = view_params(camera, T_camera_world.detach().double().numpy(), options), len(m)
    means2d, conics, z, radii, slopes = (m.new_empty(n, columns) for columns in (2, 3, 1, 2, 2))
    _core.project_forward(view, m, q, s, means2d, conics, z, radii, slopes)
    return slopes


project = project_with(_Project, reference.project)
blend = blend_with(_Blend, FEATURES_AT_ONCE, reference.blend)
