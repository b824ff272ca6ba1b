"""Render with the compiled CPU kernels: `project` and `blend` as autograd operators in float32, and a view."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat import env
from sigmasplat.config import RenderConfig
from sigmasplat.config.input import SensorModel
from sigmasplat.data.camera import Camera
from sigmasplat.errors import BackendError
from sigmasplat.native import _core
from sigmasplat.render import reference
from sigmasplat.render.kernels import blend_with, pose_gradient, project_with, view_params
from sigmasplat.render.view import NO_LAYERS, Layers
from sigmasplat.types import Matrix

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
        compiled = next(planes for planes in (4, 7, 11, 16) if planes >= k)  # counts of features of the kernels
        sums = torch.empty(compiled, rows, columns)
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


class CpuView:
    """A view on the compiled kernels."""

    backend = "cpu"
    sensor: SensorModel | None = None

    def __init__(self, camera: Camera, options: RenderConfig, variance: bool = True) -> None:
        self.camera, self.options = camera, options
        self.raster = _core.Rasteriser()
        """The kernels' buffers of this view. `fit` steps a field with them (`Rasteriser.step`)."""
        self._k = 7 if variance else 4
        size = padded_size(camera)
        self.sums, self.g_sums = torch.zeros(self._k, *size), torch.zeros(self._k, *size)
        self.alpha, self.g_alpha = torch.zeros(size), torch.zeros(size)
        self.moment, self.g_moment, self._reference = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self.layers, self.g_median_depth = Layers.of(*size), torch.zeros(size)
        self._made, self._splats = (False, False), 0
        self.seconds = np.zeros(5)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False,
        harmonics: _core.Harmonics | None = None,
    ) -> None:  # fmt: skip
        """Render rows [N, 17] as `View.forward` does: planes [K, rows, columns], m and m², padded to whole tiles.

        harmonics: the view-dependent part of the colours, if any.
        """
        o, reference_depth, moment = self.options, None, None
        if depth_reference is not None:
            self._reference[: self.camera.height, : self.camera.width] = depth_reference
            reference_depth, moment = self._reference, self.moment
        self._made, self._splats = (depth_reference is not None, layers), len(params)
        view, planes = view_params(self.camera, T_camera_world, o), self.layers if layers else NO_LAYERS
        self.raster.view_forward(
            view, params, harmonics, self._k, o.alpha_min, o.transmittance_stop, o.depth == "ray",
            reference_depth, self.sums, moment, self.alpha, *planes, self.seconds[:3],
        )  # fmt: skip

    def depth_gradients(self) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return the moment's gradient, median ids and their depths' gradient: [rows, columns], or None."""
        (moment, layers), ids = self._made, self.layers.median_id
        return self.g_moment if moment else None, ids if layers else None, self.g_median_depth if layers else None

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        twist, (g_moment, median_id, g_median_depth) = np.zeros(6), self.depth_gradients()
        self.raster.view_backward(
            params, self.g_sums, g_moment, self.g_alpha, median_id, g_median_depth, g_params, grad2d, twist,
            self.seconds[3:],
        )  # fmt: skip
        return twist

    def gather(self, planes: Tensor) -> Tensor:
        """Return Σ_p w_ip g_p [N, k] of k ≤ 16 planes g [k, rows, columns] for the N splats of the last render."""
        sums = torch.empty(self._splats, len(planes))
        self.raster.gather(planes, sums)
        return sums

    def backward_pose(self, params: Tensor) -> Matrix:
        twist = np.zeros(6)
        self.raster.backward_pose(params, self.g_sums, twist, self.seconds[3:])
        return twist

    def visible(self, n: int) -> Tensor:
        seen = torch.empty(n, dtype=torch.uint8)
        self.raster.visible(seen)
        return seen.bool()
