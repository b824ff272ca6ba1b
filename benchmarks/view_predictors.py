"""Predict the squared error of a rendered view: the baselines of `uncertainty.py`, one function each.

A predictor takes a `SeenView` and returns a plane [H, W] of variances, colour² (mean over channels) or m². To add one,
append a row to `PREDICTORS`; values per splat come from `splat_statistics.STATISTICS`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from splat_statistics import MapFacts, on_host
from torch import Tensor

from sigmasplat.data.camera import Camera
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA
from sigmasplat.render import FieldRenderer, Render
from sigmasplat.types import Matrix
from sigmasplat.uncertainty.predictive import Predicted, predict

Quantity = Literal["color", "depth"]
QUANTITIES: tuple[Quantity, ...] = ("color", "depth")
"""In the order of `MapFacts.noise` and `MapFacts.prior`."""


@dataclass(frozen=True, eq=False)
class SeenView:
    """A view of a map, with all that a predictor may read; no recorded image is among it.

    rendered: its maps; depth_m [H, W]: Σwz/Σw, 0 where the map does not cover the pixel; moment [H, W]: Σ w (z − D)²
    about D = depth_m, m²; splats: planes [H, W] of the values of `splat_statistics`, by name; predicted: what the run
    itself predicts, None if it does not; exact_depth: the view is compared with true depth, not with a reading.
    """

    rendered: Render
    depth_m: Tensor
    moment: Tensor
    splats: Mapping[str, Tensor]
    facts: MapFacts
    predicted: Predicted | None
    exact_depth: bool = False

    @property
    def transmittance(self) -> Tensor:
        """Return T = 1 − A [H, W], the share of a pixel that no splat explains."""
        return (1.0 - self.rendered.alpha).clamp(min=0.0)

    @property
    def variance(self) -> Tensor:
        """Return V as VarSplat defines it, mean over the channels [H, W]."""
        return self.rendered.variance.mean(-1).clamp(min=0.0)


def see(
    facts: MapFacts,
    values: Mapping[str, Tensor],
    camera: Camera,
    T_camera_map: Matrix,
    renderer: FieldRenderer,
    exact_depth: bool = False,
) -> SeenView:
    """Render a map and the values [N] of its splats at a pose; exact_depth: as in `SeenView`."""
    with torch.inference_mode():
        rendered = on_host(renderer(facts.field, camera, T_camera_map))
        alpha = rendered.alpha
        depth_m = torch.where(alpha > COVERED_ALPHA, rendered.depth / alpha.clamp(min=COVERED_ALPHA), 0.0)
        moment = on_host(renderer(facts.field, camera, T_camera_map, depth_m)).uncertainty
    assert moment is not None, "a render with a depth reference has a moment"
    own = None
    if facts.uncertainty is not None:
        own = predict(facts.field, facts.uncertainty, camera, T_camera_map, renderer.options, renderer.backend)
    return SeenView(rendered, depth_m, moment, facts.rendered(T_camera_map, values), facts, own, exact_depth)


@dataclass(frozen=True)
class Predictor:
    """A row of the table. A `scaled` predictor has no unit: it gets the best scale for the pixels that are scored. A
    `calibrated` one is calibrated by the run itself, so it gets no temperature."""

    name: str
    quantity: Quantity
    plane: Callable[[SeenView], Tensor]
    scaled: bool = False
    calibrated: bool = False


def constant(seen: SeenView) -> Tensor:
    """Return the same for every pixel; scaled, it is the mean squared error, the best possible constant."""
    return torch.ones_like(seen.rendered.alpha)


def transmittance(seen: SeenView) -> Tensor:
    """Return 1 − A."""
    return seen.transmittance


def published_variance(seen: SeenView) -> Tensor:
    """Return V = Σ w (σ² + c²) − Ĉ² (VarSplat §1)."""
    return seen.variance


def depth_moment(seen: SeenView) -> Tensor:
    """Return U = Σ w (z − D)² / A about the rendered depth D, m² (CG-SLAM eq. 10).

    CG-SLAM's reference is the sensor's depth. Here it would reveal the error that is to be predicted.
    """
    return seen.moment.clamp(min=0.0) / seen.rendered.alpha.clamp(min=COVERED_ALPHA)


def variance_with_prior(seen: SeenView) -> Tensor:
    """Return V + (1 − A) times the variance of the colours seen so far."""
    return seen.variance + seen.transmittance * seen.facts.prior[0]


def depth_moment_with_prior(seen: SeenView) -> Tensor:
    """Return U + (1 − A) times the variance of the depths seen so far."""
    return depth_moment(seen) + seen.transmittance * seen.facts.prior[1]


def ridge_with_prior(quantity: Quantity) -> Callable[[SeenView], Tensor]:
    """Return a predictor: the ridge regression, plus (1 − A) times the variance of colour or depth seen so far."""
    prior = QUANTITIES.index(quantity)
    return lambda seen: seen.splats[f"ridge_{quantity}"] + seen.transmittance * seen.facts.prior[prior]


def predictive_color(seen: SeenView) -> Tensor:
    """Return the predictive variance of colour (`uncertainty.predictive`); the best constant if the run has none."""
    return constant(seen) * seen.facts.noise[0] if seen.predicted is None else seen.predicted.color


def predictive_depth(seen: SeenView) -> Tensor:
    """Return the predictive variance of depth, m², as `predictive_color`: about the true depth if the view has it, else
    about a reading of the sensor."""
    if seen.predicted is None:
        return constant(seen) * seen.facts.noise[1]
    return seen.predicted.depth_std_m.square() if seen.exact_depth else seen.predicted.reading_m2


def splat_plane(name: str) -> Callable[[SeenView], Tensor]:
    """Return a predictor that reads the rendered values of a statistic."""
    return lambda seen: seen.splats[name].clamp(min=0.0)


PREDICTORS: tuple[Predictor, ...] = (
    Predictor("constant", "color", constant, scaled=True),
    Predictor("1 - A", "color", transmittance, scaled=True),
    Predictor("U", "color", depth_moment, scaled=True),
    Predictor("V", "color", published_variance),
    Predictor("ridge", "color", splat_plane("ridge_color")),
    Predictor("Fisher", "color", splat_plane("fisher_color")),
    Predictor("V + T prior", "color", variance_with_prior),
    Predictor("ridge + T prior", "color", ridge_with_prior("color")),
    Predictor("predictive", "color", predictive_color, calibrated=True),
    Predictor("constant", "depth", constant, scaled=True),
    Predictor("1 - A", "depth", transmittance, scaled=True),
    Predictor("U", "depth", depth_moment),
    Predictor("ridge", "depth", splat_plane("ridge_depth")),
    Predictor("Fisher", "depth", splat_plane("fisher_depth")),
    Predictor("U + T prior", "depth", depth_moment_with_prior),
    Predictor("ridge + T prior", "depth", ridge_with_prior("depth")),
    Predictor("predictive", "depth", predictive_depth, calibrated=True),
)
"""All predictors, in the order of the table."""
