"""What a map predicts its errors with: variances of its splats, the background, and the weights of each part."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from torch import Tensor

COLOR_PARTS = ("mixture", "residual", "unexplained", "edges", "extrapolated", "floor")
"""Parts of the predicted variance of colour, in the order of `uncertainty.predictive.variance_parts`."""
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
    """Nonnegative weights a_k by part: V = s Σ_k a_k V_k for colour (colour²) and for depth (m²).

    temperature: s by quantity, 1 if not given. The weights have the highest likelihood. Errors have heavier tails than
    a Gaussian, so more than 68 % of them would be within one standard deviation. Half way (in its logarithm) between
    the highest likelihood and 68 % lies s. It is fitted to several sequences.
    """

    color: Mapping[str, float]
    depth: Mapping[str, float]
    temperature: Mapping[str, float] = field(default_factory=dict)

    def weights(self, quantity: str) -> dict[str, float]:
        """Return the weights of "color" or "depth" times its temperature."""
        of = {"color": self.color, "depth": self.depth}[quantity]
        return {name: self.temperature.get(quantity, 1.0) * weight for name, weight in of.items()}


SHIPPED = Calibration(
    color={
        "mixture": 0.036, "residual": 0.78, "unexplained": 0.78, "edges": 7.2e-07, "extrapolated": 5.8,
        "floor": 1.6e-07,
    },
    depth={
        "ray": 0.0026, "residual": 0.8, "unexplained": 0.013, "edges": 1.2e-06, "extrapolated": 0.59,
        "sensor": 3.3e-09, "floor": 4.2e-08,
    },
    temperature={"color": 0.9, "depth": 0.95},
)  # fmt: skip
"""Weights and temperatures of the presets, fitted by `benchmarks/uncertainty_weights.py` to several sequences with
`sigma`. The fit of a run starts at these weights."""


@dataclass(frozen=True)
class Background:
    """The light that no splat explains: mean colour, its variance (mean over channels) and the variance of depth, m²,
    over the keyframes of a map."""

    color: tuple[float, float, float]
    color_variance: float
    depth_variance_m2: float


@dataclass(frozen=True, eq=False)
class SplatStd:
    """Standard deviation of what each splat shows (`calibration.splat_std`): depth_std_m [N] of its surface, m;
    color_std [N], the root of the variance averaged over red, green and blue, for colours in [0, 1]."""

    depth_std_m: Tensor
    color_std: Tensor

    def at(self, rows: Tensor) -> "SplatStd":
        """Return the values of the splats selected by a mask [N] or by indices."""
        return SplatStd(self.depth_std_m[rows], self.color_std[rows])


@dataclass(frozen=True, eq=False)
class MapUncertainty:
    """How sure a map is.

    splats [N, 6], columns as `SPLAT_COLUMNS`: the variance of each splat's residuals at the keyframes, of colour (mean
    over channels) and of depth (m²); the variance of its own depth (m²): the squared mean of its residuals, plus their
    variance about the mean over the number of readings; the mean of the unit vectors from the splat to the keyframes'
    cameras, in the map's frame: it is shorter than 1 if the directions differ. calibration: weights of the parts;
    probes: the number of probe views that it was fitted on. std: the standard deviations of the splats, None if they
    were not measured.
    """

    splats: Tensor
    background: Background
    calibration: Calibration
    probes: int = 0
    std: SplatStd | None = None

    def at(self, rows: Tensor) -> "MapUncertainty":
        """Return the values of the splats selected by a mask [N] or by indices."""
        std = None if self.std is None else self.std.at(rows)
        return replace(self, splats=self.splats.cpu()[rows], std=std)
