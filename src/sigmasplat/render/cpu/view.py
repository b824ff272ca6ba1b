"""A view on the compiled CPU kernels."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.config.sensors import SensorModel
from sigmasplat.data.camera import Camera
from sigmasplat.render.kernel_params import view_params
from sigmasplat.render.view import NO_LAYERS, Layers
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.native import _core

NO_GATE_M = 0.0
"""The kernels can also damp depth behind the median depth (GauS-SLAM); nothing uses this."""


class CpuView:
    """A view on the compiled kernels."""

    backend = "cpu"
    sensor: SensorModel | None = None

    def __init__(self, camera: Camera, options: RenderConfig, variance: bool = True) -> None:
        from sigmasplat.native import _core
        from sigmasplat.render.cpu import operators as cpu

        self.camera, self.options = camera, options
        self.raster = _core.Rasteriser()
        """The kernels' buffers of this view. `fit` steps a field with them (`Rasteriser.step`)."""
        self._k = 7 if variance else 4
        size = cpu.padded_size(camera)
        self.sums, self.g_sums = torch.zeros(self._k, *size), torch.zeros(self._k, *size)
        self.alpha, self.g_alpha = torch.zeros(size), torch.zeros(size)
        self.moment, self.g_moment, self._reference = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self.layers, self.g_median_depth = Layers.of(*size), torch.zeros(size)
        self._made, self._splats = (False, False), 0
        self.seconds = np.zeros(5)

    def forward(
        self,
        params: Tensor,
        T_camera_world: Matrix,
        depth_reference: Tensor | None = None,
        layers: bool = False,
        harmonics: "_core.Harmonics | None" = None,
    ) -> None:
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
            view, params, harmonics, self._k, o.alpha_min, o.transmittance_stop, o.depth == "ray", NO_GATE_M,
            reference_depth, self.sums, moment, self.alpha, *planes, self.seconds[:3],
        )  # fmt: skip

    def depth_gradients(self) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return the moment's gradient, median ids and their depths' gradient: [rows, columns], or None."""
        (moment, layers), ids = self._made, self.layers.median_id
        return self.g_moment if moment else None, ids if layers else None, self.g_median_depth if layers else None

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        """Write the gradient of the rows to g_params [N, 17], and grad2d [N] if given. Return the pose twist (ρ, φ)
        [6]."""
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
        """Return the pose twist (ρ, φ) [6] from the gradient planes of colour and depth; params are rows [N, 17]."""
        twist = np.zeros(6)
        self.raster.backward_pose(params, self.g_sums, twist, self.seconds[3:])
        return twist

    def visible(self, n: int) -> Tensor:
        """Return which of the n splats of the last render reach the image, bool [n]."""
        seen = torch.empty(n, dtype=torch.uint8)
        self.raster.visible(seen)
        return seen.bool()

    @property
    def bytes(self) -> int:
        """Return the memory held by this view's buffers."""
        return self.raster.bytes + 4 * 2 * (self.sums.numel() + 2 * self.alpha.numel())
