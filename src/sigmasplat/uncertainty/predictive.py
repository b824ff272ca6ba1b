"""Predict the squared error of a rendered view: of colour and of depth, as a sum of named parts.

Published variances leave parts out: V (VarSplat) and U (CG-SLAM) are 0 where the map is empty. Here the light that no
splat explains has a mean and a variance too, and the weights of the parts are fitted to views that the map has not seen
(`uncertainty.calibration`).

Values of splats are blended beside their colours, and values of pixels summed over each splat, with the same weights:
w_ip of splat i at pixel p is that of the render, Ĉ_p = Σ_i w_ip c_i.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.render.backend import backend_module, on_device
from sigmasplat.render.kernels import Projection, depth_of, plane_features
from sigmasplat.render.render import CENTER, colors_from
from sigmasplat.uncertainty.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    EPISTEMIC,
    VARIANCES,
    Background,
    Calibration,
    MapUncertainty,
)

MEANS, QUATS = COLUMNS["means"], COLUMNS["quats"]
OWN = 6
"""Channels before the values: colour, depth, second moments of colour and of depth."""


@dataclass(frozen=True, eq=False)
class BlendedValues:
    """Sums over the splats of each pixel: color Σwc [H, W, 3], depth Σwz [H, W] m (z along the ray with
    `render.depth=ray`), second Σw(σ²+c²) [H, W] mean over the
    channels, values Σwv [H, W, K], alpha Σw [H, W]; rows [n]: the splats that can reach the image."""

    color: Tensor
    depth: Tensor
    second: Tensor
    values: Tensor
    alpha: Tensor
    _center_depth: Tensor
    _depth_second: Tensor
    _center_m: float
    _sums: Tensor
    _features: Tensor
    rows: Tensor
    _splats: int

    def moment_about(self, depth_m: Tensor) -> Tensor:
        """Return U = Σw(z − D)² ≥ 0 of the splats' centres about reference depths D [H, W] m (CG-SLAM eq. 10)."""
        off, depth = depth_m - self._center_m, self._center_depth - self.alpha * self._center_m
        return (self._depth_second - 2.0 * off * depth + off.square() * self.alpha).clamp(min=0.0)

    def gather(self, planes: Tensor) -> Tensor:
        """Return Σ_p w_ip g_p [N, k] of planes g [H, W, k] with k ≤ 6 + K; call it once, on a blend with `gather`.

        A pixel is linear in the values of its splats, so this is the gradient of the values if g is that of the image.
        """
        k = planes.shape[-1]
        total = (self._sums[..., :k] * planes).sum()  # given a gradient instead, torch would load sympy: half a second
        (found,) = torch.autograd.grad(total, self._features)
        return found.new_zeros(self._splats, k).index_copy_(0, self.rows, found[:, :k])


def reaching(p: Projection, camera: Camera, options: RenderConfig) -> Tensor:
    """Return the rows [n] of the splats that can reach the image, and possibly a few more."""
    reach = p.radii * (1.001 * math.sqrt(2.0 * math.log(1.0 / options.alpha_min))) + 1.0
    size = p.means2d.new_tensor([camera.width, camera.height])
    inside = (p.means2d + reach >= 0.0) & (p.means2d - reach <= size)
    return ((p.radii[:, 0] > 0) & inside.all(1)).nonzero().squeeze(1)


def blend_values(
    field: GaussianField, camera: Camera, T_camera_map: NDArray[np.floating],
    values: Tensor | Callable[[Tensor], Tensor], options: RenderConfig, backend: str, gather: bool = False,
) -> BlendedValues:  # fmt: skip
    """Blend values [N, K] of a field's splats at a pose (4×4), on the device that holds the field.

    values: all of them, or a function that returns those of some rows [n].

    Raises BackendError if the backend is not available.
    """
    kernels, T = backend_module(backend, field.params.device), torch.as_tensor(T_camera_map)
    with torch.no_grad():
        scales = field.params[:, COLUMNS["log_scales"]].contiguous().exp()  # contiguous: much faster
        whole = kernels.project(field.means, field.quats, scales, T, camera, options)
        rows = reaching(whole, camera, options)
        p, own = Projection(*(x[rows] for x in whole)), field.params[rows]
        variances = own[:, COLUMNS["log_variances"]].contiguous().exp()
        center_m = float(p.z.mean()) if len(rows) else 0.0  # keeps the squares small: float32 loses digits
        colors = colors_from(field, T, rows)
        second = (variances + colors.square()).mean(1)
        shared = torch.cat([colors, torch.stack([p.z, second, (p.z - center_m).square()], 1)], 1)
        features = torch.cat([shared, (values(rows) if callable(values) else values.to(p.z)[rows]).to(p.z)], 1)
        end = features.shape[1]
        if options.depth == "ray":
            slopes = kernels.depth_slopes(own[:, MEANS], own[:, QUATS], scales[rows], T, camera, options)
            features = torch.cat([features, plane_features(p, slopes, camera)], 1)
        opacities = own[:, 10].sigmoid()
    with torch.set_grad_enabled(gather):
        features.requires_grad_(gather)
        b = kernels.blend(*p, opacities, features, None, camera, options)
    sums = b.sums.detach()
    depth = depth_of(sums[..., end:], camera) if options.depth == "ray" else sums[..., 3]
    return BlendedValues(
        sums[..., :3], depth, sums[..., 4], sums[..., OWN:end], b.alpha.detach(), sums[..., 3], sums[..., 5],
        center_m, b.sums, features, rows, len(field),
    )  # fmt: skip


NEW_ANGLE = 0.004
"""1 − cos 5°: at this distance from the directions that a splat was seen from, half of it counts as extrapolated."""
SPREADS = 2.0
"""Directions within this multiple of the spread 1 − |m| of the seen ones about their mean m are not new."""
COVERED = 0.5
"""Depth is divided by at least this alpha: where the map covers less of a pixel, it has no depth."""


@dataclass(frozen=True, eq=False)
class VarianceParts:
    """Unweighted parts of the variance of a view, and the rendered view itself.

    Variance: color [6, H, W] in the order of `COLOR_PARTS`, depth [7, H, W] in the order of `DEPTH_PARTS`; systematic
    [H, W] replaces the part residual of depth in the variance of the map's own depth, which has no sensor noise.
    View: image Ĉ [H, W, 3], depth_m D̂/A [H, W], alpha [H, W]; seen: the blend of the splats.

    Colour: mixture = Σw(σ²+c²) − |Ĉ|²/A, the variance among the splats of a pixel; residual = Σ w r², r² the squared
    residual of a splat at the keyframes; unexplained = T (σ_b² + A |c_b − Ĉ/A|²) + T² |c_b|², T = 1 − A, of a
    background of mean c_b and variance σ_b²; edges = |∇Ĉ|² per rad², the effect of a shift of the image;
    extrapolated = residual · G, G the mean of `novelty` over the splats of a pixel; floor = 1. The first and the third
    sum to the mean squared error of Ĉ by the law of total variance; T² |c_b|² is in it because Ĉ leaves out the
    background. Depth: ray = U/A about D̂/A; residual, unexplained and edges as for colour; extrapolated = ray · G: from
    a new direction, another splat of the ray may be the surface; sensor = depth⁴; floor = 1.
    """

    color: Tensor
    depth: Tensor
    systematic: Tensor
    image: Tensor
    depth_m: Tensor
    alpha: Tensor
    seen: BlendedValues


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predicted variance [H, W] of a view: of colour (mean over channels, colour²) and of rendered depth (m², where
    alpha > ½), each in two parts; reading_m2: the variance of rendered depth about a reading of the depth sensor.

    aleatoric: noise, and detail that the map cannot show; epistemic: what more or better views would reduce.
    """

    color_aleatoric: Tensor
    color_epistemic: Tensor
    depth_aleatoric_m2: Tensor
    depth_epistemic_m2: Tensor
    reading_m2: Tensor

    @property
    def color(self) -> Tensor:
        """Return the variance of colour [H, W]."""
        return self.color_aleatoric + self.color_epistemic

    @property
    def depth_std_m(self) -> Tensor:
        """Return the standard deviation of rendered depth about the true depth [H, W], m."""
        return (self.depth_aleatoric_m2 + self.depth_epistemic_m2).sqrt()


def variance_parts(
    field: GaussianField, splats: Tensor, background: Background, camera: Camera, T_camera_map: NDArray[np.floating],
    options: RenderConfig, backend: str, gather: bool = False,
) -> VarianceParts:  # fmt: skip
    """Render the parts of a map's variance at a pose (4×4); splats [N, 6] as in `MapUncertainty`, gather as in
    `blend_values`."""
    field = on_device(field, backend)

    def values(rows: Tensor) -> Tensor:
        means, known = field.params[rows, COLUMNS["means"]].detach(), splats[rows.to(splats.device)].to(field.params)
        new = novelty(means, known[:, VARIANCES:], T_camera_map)
        return torch.cat([known[:, :VARIANCES], new[:, None]], 1)

    seen = blend_values(field, camera, T_camera_map, values, options, backend, gather=gather)
    alpha = seen.alpha
    some, covered = alpha.clamp(min=1e-6), alpha.clamp(min=COVERED)
    depth_m = seen.depth / covered
    ray = seen.moment_about(depth_m) / covered
    missing, new = (1.0 - alpha).clamp(min=0.0), seen.values[..., VARIANCES] / some
    color = [
        (seen.second - seen.color.square().mean(-1) / some).clamp(min=0.0),
        seen.values[..., 0],
        unexplained(seen.color, alpha, background),
        slope2(seen.color, camera).mean(-1),
        seen.values[..., 0] * new,
        torch.ones_like(alpha),
    ]
    depth = [
        ray,
        seen.values[..., 1] / covered,
        missing * background.depth_variance_m2,
        slope2(depth_m[..., None], camera)[..., 0],
        ray * new,
        depth_m.square().square(),
        torch.ones_like(alpha),
    ]
    systematic = seen.values[..., 2] / covered
    return VarianceParts(torch.stack(color), torch.stack(depth), systematic, seen.color, depth_m, alpha, seen)


def directions_toward(means: Tensor, T_map_camera: NDArray[np.floating]) -> Tensor:
    """Return the unit vectors [N, 3] from splats at `means` [N, 3] to a camera (4×4)."""
    away = torch.as_tensor(T_map_camera[:3, 3]).to(means) - means
    return torch.nn.functional.normalize(away, dim=1)


def novelty(means: Tensor, seen_from: Tensor, T_camera_map: NDArray[np.floating]) -> Tensor:
    """Return for each splat [N], in [0, 1), how far a view is from the directions that the splat was seen from.

    means [N, 3]: positions; seen_from [N, 3]: the mean m of unit vectors to the keyframes' cameras; 0 where it is 0, or
    without columns. With the angle θ between m and the direction to the view, x = 1 − cos θ − 2 (1 − |m|), it is
    x / (x + 1 − cos 5°).
    """
    if not seen_from.shape[1]:
        return torch.zeros(len(means)).to(means)
    mean = seen_from.to(means)
    length = mean.norm(dim=1)
    cosine = (mean * directions_toward(means, se3.inverse(np.asarray(T_camera_map)))).sum(1) / length.clamp(min=1e-6)
    beyond = (1.0 - cosine - SPREADS * (1.0 - length)).clamp(min=0.0) * (length > 0.0)
    return torch.as_tensor(beyond / (beyond + NEW_ANGLE))


def unexplained(color: Tensor, alpha: Tensor, background: Background) -> Tensor:
    """Return T (σ_b² + A |c_b − Ĉ/A|²) + T² |c_b|² [H, W] of a rendered colour Ĉ [H, W, 3], as in `VarianceParts`."""
    missing, behind = (1.0 - alpha).clamp(min=0.0), color.new_tensor(background.color)
    away = (behind - color / alpha.clamp(min=1e-6)[..., None]).square().mean(-1)
    return missing * (background.color_variance + alpha * away) + missing.square() * behind.square().mean()


def slope2(image: Tensor, camera: Camera) -> Tensor:
    """Return the squared gradient of an image [H, W, C] by central differences, per rad² of viewing angle; 0 at the
    edges of the image along the direction across them."""
    found = torch.zeros_like(image)
    found[:, 1:-1] += ((image[:, 2:] - image[:, :-2]) * (camera.fx / 2.0)).square()
    found[1:-1] += ((image[2:] - image[:-2]) * (camera.fy / 2.0)).square()
    return found


def predicted(parts: VarianceParts, calibration: Calibration) -> Predicted:
    """Weigh the parts of a view's variance and sum them.

    The depth of the map itself has no sensor noise, and its residual part is `systematic`.
    """
    color = _sums(parts.color, COLOR_PARTS, calibration.weights("color"))
    weights = calibration.weights("depth")
    reading = sum(_sums(parts.depth, DEPTH_PARTS, weights))
    own = parts.depth.clone()
    own[DEPTH_PARTS.index("residual")] = parts.systematic
    depth = _sums(own, DEPTH_PARTS, {**weights, "sensor": 0.0})
    return Predicted(*color, *depth, torch.as_tensor(reading))


def predict(
    field: GaussianField, uncertainty: MapUncertainty, camera: Camera, T_camera_map: NDArray[np.floating],
    options: RenderConfig | None = None, backend: str = "auto",
) -> Predicted:  # fmt: skip
    """Predict the variance of colour and depth of a map at a pose (4×4). Raises BackendError as `render` does."""
    known = uncertainty.splats, uncertainty.background
    parts = variance_parts(field, *known, camera, T_camera_map, options or CENTER, backend)
    return predicted(parts, uncertainty.calibration)


def _sums(planes: Tensor, names: Sequence[str], weights: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    """Return the weighted sums of the aleatoric and of the epistemic parts, [H, W] each."""
    weighted = planes * planes.new_tensor([weights[name] for name in names])[:, None, None]
    epistemic = torch.tensor([name in EPISTEMIC for name in names], device=planes.device)
    return weighted[~epistemic].sum(0), weighted[epistemic].sum(0)
