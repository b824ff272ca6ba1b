"""The view of ten planes on the compiled CPU kernels."""

import torch
from torch import Tensor

from sigmasplat.data.field import Rows
from sigmasplat.render.channels import COVARIANCE_PLANES
from sigmasplat.render.cpu import operators as cpu
from sigmasplat.render.reference.covariance_view import CovarianceView
from sigmasplat.render.view import NO_LAYERS, View

SLOTS = cpu.feature_slots(COVARIANCE_PLANES)
"""Number of planes that the kernels are compiled for: the next count after ten."""


class CpuCovarianceView(CovarianceView):
    """`CovarianceView` on the kernels' two operators."""

    backend = "cpu"
    _project = staticmethod(cpu.project)

    def __init__(self, view: View, correlations: Rows) -> None:
        from sigmasplat.native import _core

        super().__init__(view, correlations)
        self._raster = _core.Rasteriser()
        self._slots = view.sums.new_zeros(SLOTS, *view.alpha.shape)
        self.sums = self._slots[:COVARIANCE_PLANES]

    def _blend(self, radii: Tensor, with_moment: bool, layers: bool) -> None:
        """Fill the planes; the kernels write them in place."""
        camera, o = self.camera, self.options
        self._blended = [x.detach().contiguous() for x in self._splats]
        means2d, conics, z, opacities, features = self._blended
        depth, moment = (self._depth, self.moment) if with_moment else (None, None)
        planes = self.layers if layers else NO_LAYERS
        self._raster.blend_forward(
            means2d, conics, z, radii, opacities, features, camera.width, camera.height, o.alpha_min,
            o.transmittance_stop, depth, self._slots, moment, self.alpha, *planes[:4],
        )  # fmt: skip
        if layers:
            self.layers.fill_depth(z.detach())

    def _blend_backward(self, g_sums: Tensor, g_alpha: Tensor) -> tuple[Tensor, ...]:
        g_blended = tuple(torch.empty_like(x) for x in self._blended)
        g_slots = torch.cat([g_sums, torch.zeros_like(g_sums[:1])])
        self._raster.blend_backward(g_slots, None, g_alpha, *g_blended)
        return g_blended
