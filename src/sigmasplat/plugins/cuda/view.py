"""A view on the CUDA kernels: from raw parameter rows to image planes, and gradients back, without autograd."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.api import Camera, Layers, Matrix, RenderConfig, SensorModel, view_params
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.raster import Planes, Raster


class CudaView:
    """A view on the CUDA kernels: `View` with planes of exactly the image's size, on a device.

    The host waits for the device only at the end of a backward pass, when it reads the twist. Stages are not timed:
    `seconds` stay 0.
    """

    backend = "cuda"
    sensor: SensorModel | None = None

    def __init__(
        self, camera: Camera, options: RenderConfig, variance: bool = True, device: torch.device | None = None
    ) -> None:
        device = device or cuda_launch.this_device()
        self.camera, self.options = camera, options
        self.raster = Raster(cuda_launch.launcher_for(device), device)
        size = (camera.height, camera.width)
        zeros = [torch.zeros(7 if variance else 4, *size, device=device) for _ in range(2)]
        self.sums, self.g_sums = zeros
        self.alpha, self.g_alpha, self.moment, self.g_moment, self._reference, self.g_median_depth = (
            torch.zeros(size, device=device) for _ in range(6)
        )
        self.layers = Layers.of(*size, device)
        self._made = (False, False)
        self._params = view_params(camera, np.eye(4), options)
        self.seconds = np.zeros(5)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        self._params = view_params(self.camera, T_camera_world, self.options)
        if depth_reference is not None:
            self._reference.copy_(depth_reference)
        self._made = (depth_reference is not None, layers)
        self._render(params, None)

    def _render(self, params: Tensor, pose: Tensor | None) -> None:
        """Render at `_params`, or at a pose that is on the device; the host does not wait then."""
        r, n, params = self.raster, len(params), self._on_device(params)
        r.prepare(n, len(self.sums), self.camera, self.options, self.options.depth == "ray")
        r.each_splat("pack_view", self._params, pose, params, n, r.frame, r.packed)
        r.bin(within=pose is not None)
        r.blend(self._planes, self._reference if self._made[0] else None)

    def _on_device(self, params: Tensor) -> Tensor:
        """Return rows on this device, contiguous, as the kernels need them."""
        return params.detach().to(self.raster.device).contiguous()

    @property
    def _planes(self) -> Planes:
        moment, layers = self._made
        ids = tuple(self.layers) if layers else ()
        return Planes(self.sums, self.moment if moment else None, self.alpha, *ids)

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        return self.backward_on_device(params, g_params, grad2d).cpu().numpy()

    def backward_on_device(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Tensor:
        """Do the same as `backward`, but leave the twist on the device; the host does not wait."""
        (moment, layers), r = self._made, self.raster
        on_moment, reference = (self.g_moment, self._reference) if moment else (None, None)
        sums, at = r.gradients(self._planes, reference, self.g_sums, on_moment, self.g_alpha)
        on_median, twists = self._on_median() if layers else None, r.twists()
        r.each_splat(
            "chain_params", self._params, None, self._on_device(params), r.counts, sums, on_median, r.n,
            sums.shape[1], at, g_params, grad2d, twists,
        )  # fmt: skip
        return twists.sum(0)

    def _on_median(self) -> Tensor:
        """Sum ∂L/∂(median depth) over the pixels whose median depth is that of each splat, [n, 1]; with depth along the
        ray also its products with the pixel's position relative to the splat's mean, [n, 3]."""
        ids, given = self.layers.median_id.flatten().long(), self.g_median_depth.flatten()[:, None]
        if self.raster.rays and self.raster.n:
            height, width = self.alpha.shape
            at = torch.arange(height * width, device=given.device)
            pixels = torch.stack([at % width, at // width], 1)
            given = torch.cat([given, given * (pixels - self.raster.rows[ids, 3:5])], 1)
        found = torch.zeros(self.raster.n + 1, given.shape[1], device=given.device)
        # Pixels without a median splat (−1) are added to the last row. torch sorts the indices, so that the sums are
        # the same every time. The last argument promises that the rows exist, so that the host does not wait to check.
        torch.ops.aten._index_put_impl_(found, [ids], given, True, True)
        return found[:-1]

    def backward_pose(self, params: Tensor) -> Matrix:
        return self.follow_back(params, None).sum(0).cpu().numpy()

    def follow(self, params: Tensor, pose: Tensor) -> None:
        """Render rows [N, 17] to `sums` and `alpha`; T_camera_world, float32 [4, 4], is on the device. The host does
        not wait."""
        self._made = (False, False)
        self._render(params, pose)

    def follow_back(self, params: Tensor, pose: Tensor | None) -> Tensor:
        """Propagate the gradient planes of colour and depth to that pose. Return twists [blocks, 6] on the device, to
        be summed.

        They are 0 if there were more `raster.pairs` than fit into memory. None: the pose of `forward`, with all pairs.
        """
        r = self.raster
        sums = r.pose_gradients(self._planes, self.g_sums, within=pose is not None)
        twists, rows = r.twists(), self._on_device(params)
        r.each_splat("chain_pose", self._params, pose, rows, r.counts, sums, r.n, sums.shape[1], twists)
        return twists

    def visible(self, n: int) -> Tensor:
        return self.raster.visible[:n].bool()
