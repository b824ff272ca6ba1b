"""Predict the squared distance of the vertices of a mesh to the true surface: rows of the table of `uncertainty.py`.

A predictor takes a `SeenSurface` and returns a variance [V], m². To add one, append a row to `SURFACE_PREDICTORS`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from splat_statistics import MapFacts
from surface_errors import SurfaceErrors
from torch import Tensor

from sigmasplat.plugins.evaluation.reconstruct import nearest_opaque
from sigmasplat.uncertainty.map_uncertainty import SplatStd

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What a predictor may read at each vertex: values of the nearest opaque splat of the final map.

    opacity, sigma2 [V]: its opacity, and the mean of its learned σ² (colour²); splats: its `splat_statistics` [V] by
    name; std: its standard deviations, None if the run has not measured them.
    """

    opacity: Tensor
    sigma2: Tensor
    splats: Mapping[str, Tensor]
    std: SplatStd | None


@dataclass(frozen=True)
class SurfacePredictor:
    """A row of the table of surfaces; scaled, calibrated: as in `view_predictors.Predictor`."""

    name: str
    variance: Callable[[SeenSurface], Tensor]
    scaled: bool = False
    calibrated: bool = False
    quantity: Literal["surface"] = "surface"


def constant(seen: SeenSurface) -> Tensor:
    """Return the same for every vertex; scaled, it is the mean squared distance."""
    return torch.ones_like(seen.opacity)


def transparency(seen: SeenSurface) -> Tensor:
    """Return 1 − opacity."""
    return 1.0 - seen.opacity


def per_reading(seen: SeenSurface) -> Tensor:
    """Return 1/(1 + n), n the number of depth readings of the splat at the training views, weighted as in a render."""
    return 1.0 / (1.0 + seen.splats["readings"])


def learned_variance(seen: SeenSurface) -> Tensor:
    """Return the learned σ² of colour."""
    return seen.sigma2


def splat_value(name: str) -> Callable[[SeenSurface], Tensor]:
    """Return a predictor that reads a statistic."""
    return lambda seen: seen.splats[name]


def predictive(seen: SeenSurface) -> Tensor:
    """Return the square of the vertex's `depth_std_m`; a constant if the run has none."""
    return constant(seen) if seen.std is None else seen.std.depth_std_m.square()


SURFACE_PREDICTORS: tuple[SurfacePredictor, ...] = (
    SurfacePredictor("constant", constant, scaled=True),
    SurfacePredictor("1 - opacity", transparency, scaled=True),
    SurfacePredictor("1 / readings", per_reading, scaled=True),
    SurfacePredictor("raw sigma", learned_variance, scaled=True),
    SurfacePredictor("ridge", splat_value("ridge_depth")),
    SurfacePredictor("Fisher", splat_value("fisher_depth")),
    SurfacePredictor("predictive", predictive, calibrated=True),
)
"""All predictors of surfaces, in the order of the table."""


def surface_columns(errors: SurfaceErrors, facts: MapFacts, values: Mapping[str, Tensor]) -> dict[str, Floats] | None:
    """Return squared error and variances of the vertices with the columns of `uncertainty_samples.Samples`.

    facts, values: of the final map. Returns None if no splat is opaque.
    """
    rows = nearest_opaque(facts.field, errors.vertices)
    if rows is None:
        return None
    at, field, known = torch.from_numpy(rows), facts.field, facts.uncertainty
    seen = SeenSurface(
        field.opacities.cpu()[at], field.variances.cpu().mean(1)[at], {name: v[at] for name, v in values.items()},
        None if known is None or known.std is None else known.std.at(at),
    )  # fmt: skip
    ones = np.ones(len(rows), np.float32)
    columns = {"squared_error": np.square(errors.distance_m).astype(np.float32), "alpha": ones, "reading": ones}
    variances = {p.name: np.asarray(p.variance(seen).detach(), np.float32) for p in SURFACE_PREDICTORS}
    return columns | {f"variance {name}": values for name, values in variances.items()}
