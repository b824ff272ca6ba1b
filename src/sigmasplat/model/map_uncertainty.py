"""What a map predicts its errors with: variances of its splats, the background, and the weights of each part."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.model.field import GaussianField

COLOR_PARTS = ("mixture", "residual", "unexplained", "edges", "extrapolated", "floor")
"""Parts of the predicted variance of colour, in the order of `render.predictive.variance_parts`."""
DEPTH_PARTS = ("ray", "residual", "unexplained", "edges", "extrapolated", "sensor", "floor")
"""Parts of the predicted variance of depth, as `COLOR_PARTS`."""
EPISTEMIC = frozenset({"unexplained", "edges", "extrapolated"})
"""Parts that more or better views can reduce; the others are aleatoric: noise, and detail that the map cannot show."""
SPLAT_COLUMNS = ("color", "reading_m2", "depth_m2", "toward_x", "toward_y", "toward_z")
"""Columns of `MapUncertainty.splats`. Values without the last three know no viewing directions."""
VARIANCES = 3
"""How many of `SPLAT_COLUMNS` are variances."""


@dataclass(frozen=True)
class Calibration:
    """Nonnegative weights by part: V = Σ_k a_k V_k for colour (colour²) and for depth (m²)."""

    color: Mapping[str, float]
    depth: Mapping[str, float]


SHIPPED = Calibration(
    color={
        "mixture": 0.035,
        "residual": 1.1,
        "unexplained": 0.9,
        "edges": 7.7e-7,
        "extrapolated": 9.0,
        "floor": 4e-7,
    },
    depth={
        "ray": 0.0085,
        "residual": 1.4,
        "unexplained": 0.023,
        "edges": 1e-6,
        "extrapolated": 0.77,
        "sensor": 1.9e-8,
        "floor": 7.4e-8,
    },
)
"""Weights of the presets, fitted by `benchmarks/uncertainty_weights.py` to several sequences with `sigma`. The fit of a
run starts at them."""


@dataclass(frozen=True)
class Background:
    """The light that no splat explains: mean colour, its variance (mean over channels) and the variance of depth, m²,
    over the keyframes of a map."""

    color: tuple[float, float, float]
    color_variance: float
    depth_variance_m2: float


@dataclass(frozen=True, eq=False)
class MapUncertainty:
    """How sure a map is.

    splats [N, 6], columns as `SPLAT_COLUMNS`: the variance of each splat's residuals at the keyframes, of colour (mean
    over channels) and of depth (m²); the variance of its own depth (m²): the squared mean of its residuals, plus their
    variance about the mean over the number of readings; the mean of the unit vectors from the splat to the keyframes'
    cameras, in the map's frame: it is shorter than 1 if the directions differ. calibration: weights of the parts;
    probes: the number of probe views that it was fitted on.
    """

    splats: Tensor
    background: Background
    calibration: Calibration
    probes: int = 0


@dataclass(frozen=True, eq=False)
class SplatStd:
    """Standard deviation of the surface that each splat shows: depth_std_m [N] of rendered depth about the true depth,
    m; color_std [N], the root of the variance averaged over red, green and blue, for colours in [0, 1]."""

    depth_std_m: Tensor
    color_std: Tensor

    def at(self, rows: Tensor) -> "SplatStd":
        """Return the values of the splats selected by a mask [N] or by indices."""
        return SplatStd(self.depth_std_m[rows], self.color_std[rows])


def splat_std(field: GaussianField, uncertainty: MapUncertainty) -> SplatStd:
    """Return what a map predicts (`render.predictive.predicted`) for a pixel that one splat covers alone.

    Of the parts of such a pixel, only three are not 0: mixture (the splat's σ²), residual and floor. Pixels with
    several splats have more parts, so these are lower bounds of the standard deviation of a view. A splat without a
    reading of depth takes the variance of its readings, which starts at the mean of the map.
    """
    color, reading_m2, depth_m2 = uncertainty.splats[:, :VARIANCES].cpu().unbind(1)
    for_color, for_depth = uncertainty.calibration.color, uncertainty.calibration.depth
    own_m2 = torch.where(depth_m2 > 0.0, depth_m2, reading_m2)
    mixture = for_color["mixture"] * field.variances.detach().cpu().mean(1)
    return SplatStd(
        (for_depth["residual"] * own_m2 + for_depth["floor"]).sqrt(),
        (mixture + for_color["residual"] * color + for_color["floor"]).sqrt(),
    )
