"""See how colours vary together: views of ten planes instead of seven, for the full colour covariance."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.model.field import COLUMNS, Rows
from sigmasplat.render import reference
from sigmasplat.render.cuda_view import CudaView
from sigmasplat.render.numbers import view_numbers
from sigmasplat.render.render import covariance_features
from sigmasplat.render.view import NO_LAYERS, CpuView, Layers, ReferenceView, View, pull_of, reaches, twist_matrix
from sigmasplat.types import Matrix

PLANES, SLOTS = 10, 11
"""(r, g, b, z, Σ + c cᵀ ×6), and the next number of planes that the kernels are compiled for."""


class CovarianceView:
    """A view of ten planes instead of seven, which sees a field's `correlations` besides the rows it is given.

    Made of the two operators of the kernel seam, on the backend of the view it stands for; `g_correlations` [N, 3] is
    the gradient of the last backward pass.
    """

    def __init__(self, view: CpuView | ReferenceView, correlations: Rows) -> None:
        self.camera, self.options, self.seconds = view.camera, view.options, view.seconds
        self.correlations, self.g_correlations = correlations, torch.empty(0)
        self._project, self._raster = reference.project, None
        if isinstance(view, CpuView):
            from sigmasplat.native import _core
            from sigmasplat.render import cpu

            self._project, self._raster = cpu.project, _core.Rasteriser()
        size = view.alpha.shape
        self._slots = view.sums.new_zeros(SLOTS, *size)
        self.sums, self.g_sums = self._slots[:PLANES], view.sums.new_zeros(PLANES, *size)
        self.alpha, self.g_alpha, self.moment, self._depth = (view.sums.new_zeros(size) for _ in range(4))
        self.g_moment, self.g_median_depth = (view.sums.new_zeros(size) for _ in range(2))
        self.layers = Layers.of(*size)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        parts = [params[:, columns] for columns in COLUMNS.values()]
        self._leaves = [x.detach().contiguous().requires_grad_() for x in (*parts, self.correlations.params)]
        means, quats, log_scales, logits, colors, log_variances, correlations = self._leaves
        self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        T = torch.linalg.matrix_exp(twist_matrix(self._twist)) @ torch.as_tensor(T_camera_world)
        p = self._project(means, quats, log_scales.exp(), T, self.camera, self.options)
        opacities = torch.sigmoid(logits[:, 0])
        features = covariance_features(colors, p.z, log_variances.exp(), correlations)
        self._splats = (p.means2d, p.conics, p.z, opacities, features)
        self._visible = reaches(p, opacities.detach(), self.camera, self.options)
        if depth_reference is not None:
            self._depth[: self.camera.height, : self.camera.width] = depth_reference
        self._blend(p.radii, depth_reference is not None, layers)

    def _blend(self, radii: Tensor, with_moment: bool, layers: bool) -> None:
        """Fill the planes; the kernels write them as they are."""
        camera, o = self.camera, self.options
        self._blended = [x.detach().contiguous().requires_grad_(self._raster is None) for x in self._splats]
        means2d, conics, z, opacities, features = self._blended
        depth, moment = (self._depth, self.moment) if with_moment else (None, None)
        if self._raster is not None:
            planes = self.layers if layers else NO_LAYERS
            self._raster.blend_forward(
                means2d, conics, z, radii, opacities, features, camera.width, camera.height, o.alpha_min,
                o.transmittance_stop, depth, self._slots, moment, self.alpha, *planes[:4],
            )  # fmt: skip
            if layers:
                self.layers.fill_depth(z.detach())
            return
        b = reference.blend(means2d, conics, z, radii, opacities, features, depth, camera, o)
        self._maps = (b.sums.movedim(-1, 0), b.alpha)
        self.sums.copy_(self._maps[0].detach())
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
        if layers:
            self.layers.fill(b, z.detach())

    def backward(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Matrix:
        *gradients, self.g_correlations, g_twist = self._carry(self.g_sums, self.g_alpha)
        if pull is not None:
            pull.copy_(pull_of(self._g_means2d, self.camera))
        for columns, gradient in zip(COLUMNS.values(), gradients, strict=True):
            g_params[:, columns] = gradient
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        g_sums = torch.zeros_like(self.g_sums)
        g_sums[:4] = self.g_sums[:4]
        return np.asarray(self._carry(g_sums, torch.zeros_like(self.alpha))[-1].numpy(), np.float64)

    def _carry(self, g_sums: Tensor, g_alpha: Tensor) -> tuple[Tensor, ...]:
        """Carry gradient planes to the columns of the rows, the correlations and the twist."""
        if self._raster is None:
            g_blended = torch.autograd.grad(self._maps, self._blended, (g_sums, g_alpha), materialize_grads=True)
        else:
            g_blended = tuple(torch.empty_like(x) for x in self._blended)
            g_slots = torch.cat([g_sums, torch.zeros_like(g_sums[:1])])
            self._raster.blend_backward(g_slots, None, g_alpha, *g_blended)
        self._g_means2d = g_blended[0]
        return torch.autograd.grad(self._splats, (*self._leaves, self._twist), g_blended, materialize_grads=True)

    def visible(self, n: int) -> Tensor:
        return self._visible


class CudaCovarianceView(CudaView):
    """The same on a CUDA device, for a view that is on one; the host waits where `CudaView` has it wait."""

    def __init__(self, view: CudaView, correlations: Rows) -> None:
        super().__init__(view.camera, view.options, device=view.raster.device)
        self.raster.capacity, self.stages = view.raster.capacity, view.stages
        self.correlations, self.g_correlations = correlations, torch.empty(0)
        self.sums, self.g_sums = (view.sums.new_zeros(PLANES, *view.alpha.shape) for _ in range(2))

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        r, n, here = self.raster, len(params), self._here(params)
        self._numbers = view_numbers(self.camera, T_camera_world, self.options)
        self._made = (depth_reference is not None, layers)
        if depth_reference is not None:
            self._reference.copy_(depth_reference)
        r.prepare(n, PLANES, self.camera, self.options)
        with self.stages.of("project"):
            self._project([here[:, columns].contiguous() for columns in COLUMNS.values()])
        with self.stages.of("sort"):
            r.bin()
        with self.stages.of("blend"):
            r.blend(self._planes, self._reference if depth_reference is not None else None)

    def _project(self, parts: list[Tensor]) -> None:
        """Pack splats, given by the columns of their rows, as the image shows them."""
        r, (means, quats, log_scales, *looks) = self.raster, parts
        self._shapes = means, quats, log_scales.exp()
        means2d, conics, z, radii = r.empty(r.n, 2), r.empty(r.n, 3), r.empty(r.n), r.empty(r.n, 2)
        r.each_splat("project_splats", self._numbers, None, *self._shapes, r.n, means2d, conics, z, radii)
        self._leaves = [x.detach().requires_grad_() for x in (*looks, self.correlations.params, z)]
        logits, colors, log_variances, correlations, depths = self._leaves
        features = covariance_features(colors, depths, log_variances.exp(), correlations)
        self._looks = torch.sigmoid(logits[:, 0]), features.contiguous()
        self._seen = means2d, conics, z, radii
        r.each_splat("pack_given", *self._seen, *self._looks, r.n, PLANES, r.frame, r.packed)

    def backward_there(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Tensor:
        *gradients, twist, on_means2d = self._carry_there(self.g_sums, self.g_alpha, *self._made)
        *gradients, self.g_correlations = gradients
        for columns, gradient in zip(COLUMNS.values(), gradients, strict=True):
            g_params[:, columns] = gradient
        if pull is not None:
            half = self.camera.width / 2, self.camera.height / 2
            pull.copy_(((on_means2d[:, 0] * half[0]).square() + (on_means2d[:, 1] * half[1]).square()).sqrt())
        return twist

    def backward_pose(self, params: Tensor) -> Matrix:
        g_sums = torch.zeros_like(self.g_sums)
        g_sums[:4] = self.g_sums[:4]
        return self._carry_there(g_sums, torch.zeros_like(self.alpha), False, False)[-2].cpu().numpy()

    def _carry_there(self, g_sums: Tensor, g_alpha: Tensor, moment: bool, layers: bool) -> tuple[Tensor, ...]:
        """Carry gradient planes to the columns of the rows, the correlations, the twist, and the means on the image."""
        r, (_, conics, z, radii) = self.raster, self._seen
        on_moment, reference_depth = (self.g_moment, self._reference) if moment else (None, None)
        with self.stages.of("blend_backward"):
            sums, at = r.gradients(self._planes, reference_depth, g_sums, on_moment, g_alpha)
        with self.stages.of("project_backward"):
            on_image = r.empty(r.n, 2), r.empty(r.n, 3), r.empty(r.n)
            on_looks = r.empty(r.n), r.empty(r.n, PLANES)
            r.each_splat(
                "chain_given", conics, z, self._looks[0], r.counts, sums, r.n, PLANES, sums.shape[1], at,
                *on_image, *on_looks,
            )  # fmt: skip
            *looks, on_z = torch.autograd.grad(
                self._looks, self._leaves, on_looks, retain_graph=True, materialize_grads=True
            )
            on_image[2].add_(on_z + self._on_median() if layers else on_z)
            on_shapes, twists = [torch.empty_like(x) for x in self._shapes], r.twists()
            r.each_splat(
                "project_splats_backward", self._numbers, None, *self._shapes, radii, *on_image, r.n,
                *on_shapes, twists,
            )  # fmt: skip
            means, quats, scales = on_shapes
            return means, quats, scales * self._shapes[2], *looks, twists.sum(0), on_image[0]


def covariance_view(view: View, correlations: Rows) -> CovarianceView | CudaCovarianceView:
    """Make the view of ten planes that goes with a view of seven."""
    if isinstance(view, CudaView):
        return CudaCovarianceView(view, correlations)
    assert isinstance(view, CpuView | ReferenceView), "there are three backends"
    return CovarianceView(view, correlations)
