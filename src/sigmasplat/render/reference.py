"""Define the kernels in plain torch: slow, exact, readable, any float type. Compiled backends are tested against this.

Pixel centres have integer coordinates, (u, v) = (column, row). Depth is z along the optical axis in metres.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from sigmasplat.config import RenderConfig
from sigmasplat.config.input import SensorModel
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.render.kernels import (
    FRUSTUM_MARGIN,
    PLANES,
    Blended,
    Projection,
    depth_at,
    depth_of,
    features_of,
    plane_features,
    twist_matrix,
)
from sigmasplat.render.view import Layers
from sigmasplat.types import Matrix

ALPHA_MAX = 0.99
"""Maximum alpha of a splat at a pixel, so that the backward pass can divide by 1 − α (3DGS)."""
PAIRS_AT_ONCE = 1 << 22


def project(
    means: Tensor, quats: Tensor, scales: Tensor, T_camera_world: Tensor, camera: Camera, options: RenderConfig
) -> Projection:
    """Project splats to the image (EWA splatting, 3DGS eq. 5; CG-SLAM eq. 2).

    means [N, 3] m, world; quats [N, 4] wxyz, any norm; scales [N, 3] m, activated; T_camera_world [4, 4]. The pose
    gradient is the sum of three paths: mean, covariance, depth (CG-SLAM §2.1). Without
    `covariance_pose_gradient` the covariance has a constant pose.
    """
    T = T_camera_world.to(means)
    in_view = (means @ T[:3, :3].T + T[:3, 3])[:, 2].detach() > options.near_m
    T_covariance = T if options.covariance_pose_gradient else T.detach()
    x, y, depth = _to_camera(means, T, in_view).unbind(1)
    means2d = torch.stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy], 1)
    A, _ = _footprints(means, quats, scales, T_covariance, in_view, camera)
    conics, radii = _whiten(A, options.low_pass_px2)
    z = means @ T[2, :3] + T[2, 3]
    seen = in_view[:, None]
    return Projection(
        torch.where(seen, means2d, 0.0),
        torch.where(seen, conics, 0.0),
        torch.where(in_view, z, z.detach()),
        torch.where(seen, radii, 0.0),
    )


def depth_slopes(
    means: Tensor, quats: Tensor, scales: Tensor, T_camera_world: Tensor, camera: Camera, options: RenderConfig
) -> Tensor:
    """Return how the depth of each splat changes over the image, m/px [N, 2]; 0 for a culled splat.

    Along the ray of a pixel, a splat is densest at depth z + slopes · (pixel − mean): the mean of depth for a given
    image position under the projected Gaussian, with low-pass (RaDe-GS, with z instead of the distance). The pose
    gradient is the path through the covariance.
    """
    T = T_camera_world.to(means)
    in_view = (means @ T[:3, :3].T + T[:3, 3])[:, 2].detach() > options.near_m
    A, along_axis = _footprints(
        means, quats, scales, T if options.covariance_pose_gradient else T.detach(), in_view, camera
    )
    l1, l2, l3 = _whiten(A, options.low_pass_px2)[0].unbind(1)
    with_u, with_v = (A * along_axis[:, None]).sum(2).unbind(1)
    shared = l1 * with_u + l2 * with_v
    slopes = torch.stack([l1 * shared, l2 * shared + l3 * l3 * with_v], 1)
    return torch.where(in_view[:, None], slopes, 0.0)


def _to_camera(means: Tensor, T: Tensor, in_view: Tensor) -> Tensor:
    """Transform positions [N, 3] to the camera frame; culled ones become (0, 0, 1), where every gradient is finite."""
    p = means @ T[:3, :3].T + T[:3, 3]
    return torch.where(in_view[:, None], p, p.new_tensor([0.0, 0.0, 1.0]))


def _footprints(
    means: Tensor, quats: Tensor, scales: Tensor, T: Tensor, in_view: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Build A = J R_cw R_q diag(s), [N, 2, 3] px: the splat's axes in the image, Σ2D = A Aᵀ + low-pass; and the axes
    along the optical axis, [N, 3] m."""
    J = _projection_jacobian(_to_camera(means, T, in_view), camera)
    axes = rotations(quats) * scales[:, None, :]
    return J @ T[:3, :3] @ axes, (T[2, :3] @ axes)


def _projection_jacobian(p: Tensor, camera: Camera) -> Tensor:
    """Linearise the pinhole at p [N, 3] → [N, 2, 3], with x/z and y/z clamped to the enlarged image (3DGS)."""
    x, y, z = p.unbind(1)
    margin_u, margin_v = FRUSTUM_MARGIN * camera.width, FRUSTUM_MARGIN * camera.height
    tx = (x / z).clamp(-(camera.cx + margin_u) / camera.fx, (camera.width - camera.cx + margin_u) / camera.fx)
    ty = (y / z).clamp(-(camera.cy + margin_v) / camera.fy, (camera.height - camera.cy + margin_v) / camera.fy)
    zero = torch.zeros_like(z)
    row_u = torch.stack([camera.fx / z, zero, -camera.fx * tx / z], 1)
    row_v = torch.stack([zero, camera.fy / z, -camera.fy * ty / z], 1)
    return torch.stack([row_u, row_v], 1)


def rotations(quats: Tensor) -> Tensor:
    """Convert quaternions [N, 4] wxyz of any norm to rotations [N, 3, 3]."""
    w, x, y, z = normalize(quats, dim=1).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def _whiten(A: Tensor, low_pass_px2: float) -> tuple[Tensor, Tensor]:
    """Factor (A Aᵀ + low_pass·I)⁻¹: conics [N, 3], and standard deviations [N, 2] px, detached.

    The determinant is computed as a sum of positive terms (Lagrange's identity); ca·cc − cb² would cancel on needles.
    """
    a, b = A.unbind(1)
    aa, bb, cb = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    cross = torch.linalg.cross(a, b)
    det = (cross * cross).sum(1) + low_pass_px2 * (aa + bb) + low_pass_px2**2
    ca, cc = aa + low_pass_px2, bb + low_pass_px2
    conics = torch.stack([(cc / det).sqrt(), -cb / (cc * det).sqrt(), cc.rsqrt()], 1)
    return conics, torch.stack([ca, cc], 1).detach().sqrt()


def blend(
    means2d: Tensor, conics: Tensor, z: Tensor, radii: Tensor, opacities: Tensor, features: Tensor,
    ref_depth: Tensor | None, camera: Camera, options: RenderConfig, slopes: Tensor | None = None,
) -> Blended:  # fmt: skip
    """Composite splats front to back at every pixel (3DGS eq. 3; VarSplat §1; CG-SLAM eq. 3, 6, 8-10).

    means2d, conics, z, radii as `project` returns them; opacities [N]; features [N, K]; ref_depth [H, W] m or None.
    Splats are sorted by z, equal ones by index. A pair of splat and pixel counts if o·exp(power) ≥ alpha_min and the
    light before the splat is at least transmittance_stop. There is no other limit, so the result does not depend on
    tiles. Ids and their weights have no gradient. With slopes [N, 2] m/px the moment is that of the depth along the ray
    (`depth_slopes`); only this definition has them.
    """
    order, pixels = torch.sort(z.detach(), stable=True).indices, _pixels(camera).to(means2d)
    order = order[radii[order, 0] > 0]  # without culled ones
    ref = torch.zeros(len(pixels)).to(z) if ref_depth is None else ref_depth.detach().reshape(-1).to(z)
    step = max(1, PAIRS_AT_ONCE // (len(order) + 1))
    parts = [
        _blend_pixels(
            _alphas(some_pixels, means2d[order], conics[order], opacities[order], options),
            features[order],
            z[order, None] if slopes is None else _depths(some_pixels, means2d[order], z[order], slopes[order]),
            some_ref,
            order,
            options.transmittance_stop,
        )
        for some_pixels, some_ref in zip(torch.split(pixels, step), torch.split(ref, step), strict=True)
    ]
    size = (camera.height, camera.width)
    sums, moment, *maps = (torch.cat(part) for part in zip(*parts, strict=True))
    images = [m.reshape(size) for m in maps]
    return Blended(sums.reshape(*size, -1), None if ref_depth is None else moment.reshape(size), *images)


def _pixels(camera: Camera) -> Tensor:
    """Return the pixels (u, v) of an image, row by row, [H·W, 2]."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


def _alphas(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, options: RenderConfig) -> Tensor:
    """Evaluate α [N, P] = min(0.99, o·exp(power)), 0 if below alpha_min; no gradient where α is clamped."""
    dx, dy = (pixels[None] - means2d[:, None]).unbind(-1)
    l1, l2, l3 = conics[:, :, None].unbind(1)
    power = -0.5 * ((l1 * dx + l2 * dy) ** 2 + (l3 * dy) ** 2)
    raw = opacities[:, None] * power.exp()
    return torch.where(raw >= options.alpha_min, raw.clamp(max=ALPHA_MAX), 0.0)


def _depths(pixels: Tensor, means2d: Tensor, z: Tensor, slopes: Tensor) -> Tensor:
    """Return the depth along the ray [N, P] of N splats at P pixels."""
    return z[:, None] + ((pixels[None] - means2d[:, None]) * slopes[:, None]).sum(-1)


def _blend_pixels(
    alphas: Tensor, features: Tensor, z: Tensor, ref: Tensor, order: Tensor, stop: float
) -> tuple[Tensor, ...]:
    """Composite sorted splats of depths z [N, 1] or [N, P] at P pixels; returns `Blended`'s maps flat.

    A row with id −1 and α = 0 is added in front. With it, the light before each splat is the light after the previous
    row, and `argmax` finds this row if no splat qualifies.
    """
    air = alphas.new_zeros(1, alphas.shape[1])
    alphas = torch.cat([air, alphas])
    after = torch.cumprod(1.0 - alphas, 0)
    before = torch.cat([torch.ones_like(air), after[:-1]])
    counts = before >= stop
    w = torch.where(counts, alphas * before, 0.0)
    off = torch.where(ref > 0, z - ref, 0.0)
    ids = torch.cat([order.new_full((1,), -1), order]).int()
    median = (counts & (before >= 0.5) & (after < 0.5)).int().argmax(0, keepdim=True)
    dominant = w.detach().argmax(0, keepdim=True)
    return (
        w[1:].T @ features,
        (w[1:] * off**2).sum(0),
        w.sum(0),
        *(m for pick in (median, dominant) for m in (ids[pick[0]], w.detach().gather(0, pick)[0])),
    )


class ReferenceView:
    """A view with the definition in plain torch: slow, for tests."""

    backend = "reference"
    sensor: SensorModel | None = None

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
        """Render rows [N, 17] as `View.forward` does: planes [K, H, W], m and m²; nothing is padded."""
        self._leaf = params.detach().clone().requires_grad_()
        self._twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        T = torch.linalg.matrix_exp(twist_matrix(self._twist)) @ torch.as_tensor(T_camera_world)
        f = GaussianField(self._leaf)
        p = project(f.means, f.quats, f.scales, T, self.camera, self.options)
        features = features_of(f.colors, p.z, f.variances)[:, : self._k]
        slopes = None
        if self.options.depth == "ray":
            slopes = depth_slopes(f.means, f.quats, f.scales, T, self.camera, self.options)
            features = torch.cat([features, plane_features(p, slopes, self.camera)], 1)
        b = blend(*p, f.opacities, features, depth_reference, self.camera, self.options, slopes)
        sums = b.sums
        if slopes is not None:
            depth = depth_of(sums[..., -PLANES:], self.camera)[..., None]
            sums = torch.cat([sums[..., :3], depth, sums[..., 4:-PLANES]], -1)
        self._maps, self._means2d = [(sums.movedim(-1, 0), self.g_sums), (b.alpha, self.g_alpha)], p.means2d
        self._visible = reaches(p, f.opacities.detach(), self.camera, self.options)
        self.sums.copy_(sums.detach().movedim(-1, 0))
        self.alpha.copy_(b.alpha.detach())
        if b.moment is not None:
            self.moment.copy_(b.moment.detach())
            self._maps.append((b.moment, self.g_moment))
        if layers:
            for plane, image in zip(self.layers[:4], b[3:], strict=True):
                plane.copy_(image)
            rows = b.median_id.clamp(min=0).long()
            nearest = p.z[rows] if len(f) else torch.zeros_like(b.alpha)
            if slopes is not None and len(f):
                nearest = depth_at(rows, p, slopes, self.camera)
            median_depth = torch.where(b.median_id >= 0, nearest, 0.0)
            self.layers.median_depth.copy_(median_depth.detach())
            self._maps.append((median_depth, self.g_median_depth))

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        maps, gradients = zip(*self._maps, strict=True)
        leaves = (self._leaf, self._twist, self._means2d)
        g_leaf, g_twist, g_means2d = torch.autograd.grad(maps, leaves, gradients, materialize_grads=True)
        g_params.copy_(g_leaf)
        if grad2d is not None:
            half_image = g_means2d.new_tensor([self.camera.width / 2, self.camera.height / 2])
            grad2d.copy_((g_means2d * half_image).square().sum(1).sqrt())
        return np.asarray(g_twist.numpy(), np.float64)

    def backward_pose(self, params: Tensor) -> Matrix:
        (g_twist,) = torch.autograd.grad(self._maps[0][0][:4], self._twist, self.g_sums[:4], materialize_grads=True)
        return np.asarray(g_twist.numpy(), np.float64)

    def visible(self, n: int) -> Tensor:
        return self._visible


def reaches(p: Projection, opacities: Tensor, camera: Camera, options: RenderConfig) -> Tensor:
    """Return which splats can change a view, bool [N]: those whose bounds of alpha ≥ alpha_min overlap the image."""
    reach = (2.0 * (opacities / options.alpha_min).log()).clamp(min=0.0).sqrt()[:, None] * p.radii.detach()
    low, high = p.means2d.detach() - reach, p.means2d.detach() + reach
    inside = ((high >= 0) & (low <= low.new_tensor([camera.width - 1.0, camera.height - 1.0]))).all(1)
    return inside & (p.radii[:, 0] > 0) & (opacities > options.alpha_min)
