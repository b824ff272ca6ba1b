"""The view of ten planes on a CUDA device."""

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS, Rows
from sigmasplat.render.channels import COVARIANCE_PLANES, covariance_features
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.kernel_params import view_params
from sigmasplat.types import Matrix


class CudaCovarianceView(CudaView):
    """`CovarianceView` on a CUDA device, for a view that is on the device. The host waits where it waits with
    `CudaView`."""

    def __init__(self, view: CudaView, correlations: Rows) -> None:
        super().__init__(view.camera, view.options, device=view.raster.device)
        self.raster.capacity, self.stages = view.raster.capacity, view.stages
        self.correlations, self.g_correlations = correlations, torch.empty(0)
        self.sums, self.g_sums = (view.sums.new_zeros(COVARIANCE_PLANES, *view.alpha.shape) for _ in range(2))

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        r, n, rows = self.raster, len(params), self._on_device(params)
        self._params = view_params(self.camera, T_camera_world, self.options)
        self._made = (depth_reference is not None, layers)
        if depth_reference is not None:
            self._reference.copy_(depth_reference)
        r.prepare(n, COVARIANCE_PLANES, self.camera, self.options)
        with self.stages.of("project"):
            self._project([rows[:, columns].contiguous() for columns in COLUMNS.values()])
        with self.stages.of("sort"):
            r.bin()
        with self.stages.of("blend"):
            r.blend(self._planes, self._reference if depth_reference is not None else None)

    def _project(self, parts: list[Tensor]) -> None:
        """Pack splats, given by the columns of their rows, with the features that are rendered."""
        r, (means, quats, log_scales, *looks) = self.raster, parts
        self._shapes = means, quats, log_scales.exp()
        means2d, conics, z, radii = r.empty(r.n, 2), r.empty(r.n, 3), r.empty(r.n), r.empty(r.n, 2)
        r.each_splat("project_splats", self._params, None, *self._shapes, r.n, means2d, conics, z, radii)
        self._leaves = [x.detach().requires_grad_() for x in (*looks, self.correlations.params, z)]
        logits, colors, log_variances, correlations, depths = self._leaves
        features = covariance_features(colors, depths, log_variances.exp(), correlations)
        self._looks = torch.sigmoid(logits[:, 0]), features.contiguous()
        self._seen = means2d, conics, z, radii
        r.each_splat("pack_given", *self._seen, *self._looks, r.n, COVARIANCE_PLANES, r.frame, r.packed)

    def backward_on_device(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Tensor:
        *gradients, twist, on_means2d = self._carry_on_device(self.g_sums, self.g_alpha, *self._made)
        *gradients, self.g_correlations = gradients
        for columns, gradient in zip(COLUMNS.values(), gradients, strict=True):
            g_params[:, columns] = gradient
        if grad2d is not None:
            half = self.camera.width / 2, self.camera.height / 2
            grad2d.copy_(((on_means2d[:, 0] * half[0]).square() + (on_means2d[:, 1] * half[1]).square()).sqrt())
        return twist

    def backward_pose(self, params: Tensor) -> Matrix:
        g_sums = torch.zeros_like(self.g_sums)
        g_sums[:4] = self.g_sums[:4]
        return self._carry_on_device(g_sums, torch.zeros_like(self.alpha), False, False)[-2].cpu().numpy()

    def _carry_on_device(self, g_sums: Tensor, g_alpha: Tensor, moment: bool, layers: bool) -> tuple[Tensor, ...]:
        """Propagate gradient planes to the columns of the rows, the correlations, the twist, and the means on the
        image."""
        r, (_, conics, z, radii) = self.raster, self._seen
        on_moment, reference_depth = (self.g_moment, self._reference) if moment else (None, None)
        with self.stages.of("blend_backward"):
            sums, at = r.gradients(self._planes, reference_depth, g_sums, on_moment, g_alpha)
        with self.stages.of("project_backward"):
            on_image = r.empty(r.n, 2), r.empty(r.n, 3), r.empty(r.n)
            on_looks = r.empty(r.n), r.empty(r.n, COVARIANCE_PLANES)
            r.each_splat(
                "chain_given", conics, z, self._looks[0], r.counts, sums, r.n, COVARIANCE_PLANES, sums.shape[1], at,
                *on_image, *on_looks,
            )  # fmt: skip
            *looks, on_z = torch.autograd.grad(
                self._looks, self._leaves, on_looks, retain_graph=True, materialize_grads=True
            )
            on_image[2].add_(on_z + self._on_median() if layers else on_z)
            on_shapes, twists = [torch.empty_like(x) for x in self._shapes], r.twists()
            r.each_splat(
                "project_splats_backward", self._params, None, *self._shapes, radii, *on_image, r.n,
                *on_shapes, twists,
            )  # fmt: skip
            means, quats, scales = on_shapes
            return means, quats, scales * self._shapes[2], *looks, twists.sum(0), on_image[0]
