"""Render the same view again and again without allocating: raw parameter rows to image planes, and gradients back.

The loops of `fit` live on this. Planes are padded to whole tiles: [rows, columns] ≥ [H, W]; what lies outside the image
is defined but means nothing, and a loss masks it (targets have depth 0 there).
"""

from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.render import reference
from sigmasplat.render.backend import backend_module, is_cuda
from sigmasplat.render.numbers import view_numbers
from sigmasplat.render.render import features_of
from sigmasplat.types import Matrix


class Layers(NamedTuple):
    """Which splats make a pixel, planes [rows, columns]: int32 rows of the splat at median depth (CG-SLAM eq. 8) and of
    the one of largest weight, −1 = none; their weights; median_depth in m, 0 = none."""

    median_id: Tensor
    median_weight: Tensor
    dominant_id: Tensor
    dominant_weight: Tensor
    median_depth: Tensor

    @staticmethod
    def of(rows: int, columns: int, device: torch.device | None = None) -> "Layers":
        """Make empty planes, by default in the host's memory."""
        ids = [torch.zeros(rows, columns, dtype=torch.int32, device=device) for _ in range(2)]
        floats = [torch.zeros(rows, columns, device=device) for _ in range(3)]
        return Layers(ids[0], floats[0], ids[1], floats[1], floats[2])

    def fill(self, b: reference.Blended, z: Tensor) -> None:
        """Copy what was blended of splats at depths z [N] m."""
        for plane, image in zip(self[:4], b[3:], strict=True):
            plane.copy_(image)
        self.fill_depth(z)

    def fill_depth(self, z: Tensor) -> None:
        """Read the median depth off depths z [N] m."""
        nearest = z[self.median_id.clamp(min=0).long()] if len(z) else self.median_depth
        self.median_depth.copy_(torch.where(self.median_id >= 0, nearest, 0.0))


MaybeLayers = tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]
NO_LAYERS: MaybeLayers = (None, None, None, None, None)


class View(Protocol):
    """One camera with its planes: sums [K, rows, columns] of (r, g, b, z[, σ²+c² ×3]), alpha, and their gradients."""

    camera: Camera
    options: RenderConfig
    sums: Tensor
    alpha: Tensor
    g_sums: Tensor
    g_alpha: Tensor
    moment: Tensor
    """U about the reference depth of the last forward pass that was given one, [rows, columns] m² (CG-SLAM eq. 10)."""
    layers: "Layers"
    g_moment: Tensor
    g_median_depth: Tensor
    """Gradients of `moment` and of the layers' median depth: felt where the last forward pass made those."""

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Return the time spent so far in project, sort, blend, blend backward, project backward."""

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        """Render parameter rows [N, 17] at a pose into `sums` and `alpha`; with a depth [H, W] m into `moment` too, and
        if asked to into `layers`."""

    def backward(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Matrix:
        """Carry the gradient planes to parameter rows, written to g_params [N, 17]; return the pose twist [6] (ρ, φ; m,
        rad). To pull [N], where given, goes how hard each image mean is pulled, per half image size (3DGS)."""

    def backward_pose(self, params: Tensor) -> Matrix:
        """Carry the gradient planes of colour and depth to the pose alone; return the twist (ρ, φ) [6]."""

    def visible(self, n: int) -> Tensor:
        """Tell which of the n splats of the last forward pass reach the image, bool [n]."""


class CpuView:
    """A view on the compiled kernels."""

    def __init__(self, camera: Camera, options: RenderConfig, variance: bool = True) -> None:
        from sigmasplat.native import _core
        from sigmasplat.render import cpu

        self.camera, self.options = camera, options
        self.raster = _core.Rasteriser()
        """The kernels' own buffers of this view; `fit` steps a field through it (`Rasteriser.step`)."""
        self._k = 7 if variance else 4
        size = cpu.padded_size(camera)
        self.sums, self.g_sums = torch.zeros(self._k, *size), torch.zeros(self._k, *size)
        self.alpha, self.g_alpha = torch.zeros(size), torch.zeros(size)
        self.moment, self.g_moment, self._reference = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self.layers, self.g_median_depth = Layers.of(*size), torch.zeros(size)
        self._made = (False, False)
        self.seconds = np.zeros(5)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        """Render rows [N, 17] as `View.forward` says: planes [K, rows, columns], m and m², padded to whole tiles."""
        o, reference_depth, moment = self.options, None, None
        if depth_reference is not None:
            self._reference[: self.camera.height, : self.camera.width] = depth_reference
            reference_depth, moment = self._reference, self.moment
        self._made = (depth_reference is not None, layers)
        view, planes = view_numbers(self.camera, T_camera_world, o), self.layers if layers else NO_LAYERS
        self.raster.view_forward(
            view, params, self._k, o.alpha_min, o.transmittance_stop, reference_depth,
            self.sums, moment, self.alpha, *planes, self.seconds[:3],
        )  # fmt: skip

    def depth_gradients(self) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return the moment's gradient, median ids and their depths' gradient: [rows, columns], or None."""
        (moment, layers), ids = self._made, self.layers.median_id
        return self.g_moment if moment else None, ids if layers else None, self.g_median_depth if layers else None

    def backward(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Matrix:
        """Write gradients by rows, g_params [N, 17], and pull [N] if given; return the pose twist (ρ, φ) [6]."""
        twist, (g_moment, median_id, g_median_depth) = np.zeros(6), self.depth_gradients()
        self.raster.view_backward(
            params, self.g_sums, g_moment, self.g_alpha, median_id, g_median_depth, g_params, pull, twist,
            self.seconds[3:],
        )  # fmt: skip
        return twist

    def backward_pose(self, params: Tensor) -> Matrix:
        """Return the pose twist (ρ, φ) [6] of the gradient planes of colour and depth; params are rows [N, 17]."""
        twist = np.zeros(6)
        self.raster.backward_pose(params, self.g_sums, twist, self.seconds[3:])
        return twist

    def visible(self, n: int) -> Tensor:
        """Tell which of the n splats last rendered reach the image, bool [n]."""
        seen = torch.empty(n, dtype=torch.uint8)
        self.raster.visible(seen)
        return seen.bool()

    @property
    def bytes(self) -> int:
        """Return the memory held by this view's buffers."""
        return self.raster.bytes + 4 * 2 * (self.sums.numel() + 2 * self.alpha.numel())


class ReferenceView:
    """The same view on the plain-torch definition: slow, for tests and for machines without the compiled kernels."""

    def __init__(self, camera: Camera, options: RenderConfig, variance: bool = True) -> None:
        self.camera, self.options = camera, options
        self._k = 7 if variance else 4
        size = (camera.height, camera.width)
        self.sums, self.g_sums = torch.zeros(self._k, *size), torch.zeros(self._k, *size)
        self.alpha, self.g_alpha, self.moment = torch.zeros(size), torch.zeros(size), torch.zeros(size)
        self.layers, self.g_moment, self.g_median_depth = Layers.of(*size), torch.zeros(size), torch.zeros(size)
        self.seconds = np.zeros(5)

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        """Render rows [N, 17] as `View.forward` says: planes [K, H, W], m and m²; nothing is padded."""
        self._leaf = params.detach().clone().requires_grad_()
        self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        T = torch.linalg.matrix_exp(twist_matrix(self._twist)) @ torch.as_tensor(T_camera_world)
        f = GaussianField(self._leaf)
        p = reference.project(f.means, f.quats, f.scales, T, self.camera, self.options)
        features = features_of(f.colors, p.z, f.variances)[:, : self._k]
        b = reference.blend(*p, f.opacities, features, depth_reference, self.camera, self.options)
        self._maps, self._means2d = [(b.sums.movedim(-1, 0), self.g_sums), (b.alpha, self.g_alpha)], p.means2d
        self._visible = reaches(p, f.opacities.detach(), self.camera, self.options)
        self.sums.copy_(b.sums.detach().movedim(-1, 0))
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
            self._maps.append((b.moment, self.g_moment))
        if layers:
            self.layers.fill(b, p.z.detach())
            nearest = p.z[b.median_id.clamp(min=0).long()] if len(f) else torch.zeros_like(b.alpha)
            self._maps.append((torch.where(b.median_id >= 0, nearest, 0.0), self.g_median_depth))

    def backward(self, params: Tensor, g_params: Tensor, pull: Tensor | None = None) -> Matrix:
        """Write gradients by rows, g_params [N, 17], and pull [N] if given; return the pose twist (ρ, φ) [6]."""
        maps, gradients = zip(*self._maps, strict=True)
        leaves = (self._leaf, self._twist, self._means2d)
        g_leaf, g_twist, g_means2d = torch.autograd.grad(maps, leaves, gradients, materialize_grads=True)
        g_params.copy_(g_leaf)
        if pull is not None:
            pull.copy_(pull_of(g_means2d, self.camera))
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        """Return the pose twist (ρ, φ) [6] of the gradient planes of colour and depth."""
        (g_twist,) = torch.autograd.grad(self._maps[0][0][:4], self._twist, self.g_sums[:4], materialize_grads=True)
        return np.asarray(g_twist.numpy(), np.float64)

    def visible(self, n: int) -> Tensor:
        """Tell which splats last rendered reach the image, bool [n]."""
        return self._visible


def pull_of(g_means2d: Tensor, camera: Camera) -> Tensor:
    """Return how hard image means are pulled, per half image size [N], of their gradients [N, 2] per px (3DGS)."""
    half_image = g_means2d.new_tensor([camera.width / 2, camera.height / 2])
    return (g_means2d * half_image).square().sum(1).sqrt()


def reaches(p: reference.Projection, opacities: Tensor, camera: Camera, options: RenderConfig) -> Tensor:
    """Tell which splats' bounds of alpha ≥ alpha_min overlap the image, bool [N]: those a view can feel."""
    reach = (2.0 * (opacities / options.alpha_min).log()).clamp(min=0.0).sqrt()[:, None] * p.radii.detach()
    low, high = p.means2d.detach() - reach, p.means2d.detach() + reach
    inside = ((high >= 0) & (low <= low.new_tensor([camera.width - 1.0, camera.height - 1.0]))).all(1)
    return inside & (p.radii[:, 0] > 0) & (opacities > options.alpha_min)


def twist_matrix(xi: Tensor) -> Tensor:
    """Write a twist (ρ, φ) [6], m and rad, as the matrix [4, 4] whose exponential is the motion."""
    zero = torch.zeros((), dtype=xi.dtype)
    x, y, z, a, b, c = xi
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero, zero, zero, zero]]
    return torch.stack([torch.stack(row) for row in rows])


def make_view(backend: str, camera: Camera, options: RenderConfig, variance: bool = True) -> View:
    """Make a view on a backend by name (one of `BACKENDS`). Raises BackendError as `backend_module` does."""
    kernels = backend_module(backend)
    if kernels is reference:
        return ReferenceView(camera, options, variance)
    if is_cuda(kernels):
        from sigmasplat.render.cuda_view import CudaView

        return CudaView(camera, options, variance)
    return CpuView(camera, options, variance)
