"""Predict the squared error of a rendered view: of colour and of depth, as a sum of named parts.

Published variances leave parts out: V (VarSplat) and U (CG-SLAM) are 0 where the map is empty. Here the light that no
splat explains has a mean and a variance too, and the weights of the parts are fitted to views that the map has not seen
(`fit.calibration`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    EPISTEMIC,
    Background,
    Calibration,
    MapUncertainty,
)
from sigmasplat.render.blended_values import blend_values
from sigmasplat.render.render import on_device

COVERED = 0.5
"""Depth is divided by at least this alpha: where the map covers less of a pixel, it has no depth."""


@dataclass(frozen=True, eq=False)
class VarianceParts:
    """Unweighted parts of the variance of a view: color [5, H, W] as `COLOR_PARTS`, depth [6, H, W] as `DEPTH_PARTS`,
    systematic [H, W]: the part of depth that takes the place of residual for the depth of the map itself; with what was
    rendered: image Ĉ [H, W, 3], depth_m D̂/A [H, W], alpha [H, W].

    Colour: mixture = Σw(σ²+c²) − |Ĉ|²/A, the variance among the splats of a pixel; residual = Σ w r², r² the squared
    residual of a splat at the keyframes; unexplained = T (σ_b² + A |c_b − Ĉ/A|²) + T² |c_b|², T = 1 − A, of a
    background of mean c_b and variance σ_b²; edges = |∇Ĉ|² per rad², the effect of a shift of the image; floor = 1.
    The first and the third sum to the mean squared error of Ĉ by the law of total variance; Ĉ leaves out the
    background, which is the T² |c_b|² of it. Depth: ray = U/A about D̂/A; residual, unexplained and edges as for colour;
    sensor = depth⁴; floor = 1.
    """

    color: Tensor
    depth: Tensor
    systematic: Tensor
    image: Tensor
    depth_m: Tensor
    alpha: Tensor


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
    field: GaussianField,
    splats: Tensor,
    background: Background,
    camera: Camera,
    T_camera_map: NDArray[np.floating],
    options: RenderConfig,
    backend: str,
) -> VarianceParts:
    """Render the parts of a map's variance at a pose (4×4); splats [N, 3] as in `MapUncertainty`."""
    field = on_device(field, backend)
    seen = blend_values(field, camera, T_camera_map, splats, options, backend)
    alpha = seen.alpha
    some, covered = alpha.clamp(min=1e-6), alpha.clamp(min=COVERED)
    depth_m = seen.depth / covered
    about = blend_values(field, camera, T_camera_map, splats[:, :0], options, backend, depth_m).moment
    assert about is not None, "a blend with a depth reference has a moment"
    missing = (1.0 - alpha).clamp(min=0.0)
    behind = seen.color.new_tensor(background.color)
    away = (behind - seen.color / some[..., None]).square().mean(-1)
    left_out = missing.square() * behind.square().mean()
    color = [
        (seen.second - seen.color.square() / some[..., None]).mean(-1).clamp(min=0.0),
        seen.values[..., 0],
        missing * (background.color_variance + alpha * away) + left_out,
        slope2(seen.color, camera).mean(-1),
        torch.ones_like(alpha),
    ]
    depth = [
        about.clamp(min=0.0) / covered,
        seen.values[..., 1] / covered,
        missing * background.depth_variance_m2,
        slope2(depth_m[..., None], camera)[..., 0],
        depth_m.square().square(),
        torch.ones_like(alpha),
    ]
    systematic = seen.values[..., 2] / covered
    return VarianceParts(torch.stack(color), torch.stack(depth), systematic, seen.color, depth_m, alpha)


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
    color = _sums(parts.color, COLOR_PARTS, calibration.color)
    reading = sum(_sums(parts.depth, DEPTH_PARTS, calibration.depth))
    own = parts.depth.clone()
    own[DEPTH_PARTS.index("residual")] = parts.systematic
    depth = _sums(own, DEPTH_PARTS, {**calibration.depth, "sensor": 0.0})
    return Predicted(*color, *depth, torch.as_tensor(reading))


def predict(
    field: GaussianField,
    uncertainty: MapUncertainty,
    camera: Camera,
    T_camera_map: NDArray[np.floating],
    options: RenderConfig | None = None,
    backend: str = "auto",
) -> Predicted:
    """Predict the variance of colour and depth of a map at a pose (4×4). Raises BackendError as `render` does."""
    known = uncertainty.splats, uncertainty.background
    parts = variance_parts(field, *known, camera, T_camera_map, options or RenderConfig(), backend)
    return predicted(parts, uncertainty.calibration)


def _sums(planes: Tensor, names: Sequence[str], weights: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    """Return the weighted sums of the aleatoric and of the epistemic parts, [H, W] each."""
    weighted = planes * planes.new_tensor([weights[name] for name in names])[:, None, None]
    epistemic = torch.tensor([name in EPISTEMIC for name in names], device=planes.device)
    return weighted[~epistemic].sum(0), weighted[epistemic].sum(0)
