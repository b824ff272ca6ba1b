"""Score predicted variances of several runs, before and after one temperature per predictor from other sequences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from surface_predictors import SURFACE_PREDICTORS, SurfacePredictor
from uncertainty_samples import AWAY, HELD_BACK, Kind
from view_predictors import PREDICTORS, Predictor

from sigmasplat.plugins.evaluation.metrics.uncertainty import (
    EPSILON,
    ause,
    calibration_scores,
    gaussian_nll,
    over_channels,
    sparsification,
    spearman,
    z_scores,
)
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA
from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, FAINT, GREEN, PURPLE, Chart, Curve

Arrays = Mapping[str, NDArray[np.float32]]
AnyPredictor = Predictor | SurfacePredictor
EVERY: tuple[AnyPredictor, ...] = (*PREDICTORS, *SURFACE_PREDICTORS)
ALL, READ, COVERED = "all pixels", "pixels with a reading", "covered pixels"
VISIBLE = "visible vertices"
CURVES = (BLUE, GREEN, PURPLE)
MAP_TITLES = {"final": "final map"}
VIEW_TITLES = {HELD_BACK: "held-back views", AWAY: "views away from the path"}
QUANTITIES = {
    "color": ("Colour", "RMSE, 0 to 1", "pixels"),
    "depth": ("Depth", "RMSE, m", "pixels"),
    "surface": ("Surface", "RMSE, m", "vertices"),
}
"""Title, label of the error, and what is removed in a sparsification chart."""
HEADROOM = 1.15
"""Largest RMSE in a sparsification chart, as a multiple of the RMSE of all pixels."""


@dataclass(frozen=True, eq=False)
class Run:
    """The samples of one run by kind, and which sequence it is of."""

    source: str
    samples: Mapping[Kind, Arrays]


def score_runs(runs: Sequence[Run], predictors: Sequence[AnyPredictor] = EVERY) -> list[dict[Kind, dict[str, Any]]]:
    """Return the scores of each run: by kind, then by subset of pixels, then by predictor.

    The temperatures of a predictor come from the held-back views, or the surfaces, of all other sequences, for each
    quantity, map and subset of pixels: the mean of its best scales, and the geometric mean of its z_68². With a single
    sequence they are those of the run itself (`in_sample`).
    """
    scales = [_best_scales(run, predictors) for run in runs]
    found = []
    for run, own in zip(runs, scales, strict=True):
        others = [scale for other, scale in zip(runs, scales, strict=True) if other.source != run.source]
        of_kind = dict[Kind, dict[str, Any]]()
        for kind, arrays in run.samples.items():
            subset_scores = dict[str, Any]()
            for subset, pixels in subsets(kind, arrays).items():
                fitted = [scale.get((_fitted_on(kind), subset), {}) for scale in others or [own]]
                rows = _score(kind, arrays, pixels, predictors, _transferred(fitted))
                subset_scores[subset] = {"pixels": int(pixels.sum()), "in_sample": not others, "predictors": rows}
            of_kind[kind] = subset_scores
        found.append(of_kind)
    return found


def subsets(kind: Kind, arrays: Arrays) -> dict[str, NDArray[np.bool_]]:
    """Return which pixels are scored, by name. Depth is only known where the map covers the pixel."""
    covered = arrays["alpha"] > COVERED_ALPHA
    if kind.quantity == "surface":
        return {VISIBLE: covered}
    if kind.quantity == "depth":
        return {COVERED: covered}
    return {ALL: np.ones_like(covered), READ: arrays["reading"] > 0, COVERED: covered}


def _fitted_on(kind: Kind) -> Kind:
    """Return the kind of samples that temperatures come from: held-back views, or surfaces with any reference."""
    return Kind(kind.quantity, kind.map, "" if kind.quantity == "surface" else HELD_BACK)


def predicted(predictor: AnyPredictor, arrays: Arrays, pixels: NDArray[np.bool_]) -> tuple[Any, Any]:
    """Return the variance [P] (in its unit, or at its best scale if it has none) and the squared errors of some pixels,
    [P, C] for each channel."""
    variance, error2 = arrays[f"variance {predictor.name}"][pixels], arrays["squared_error"][pixels]
    if predictor.scaled:
        variance = (variance + np.float32(EPSILON)) * np.float32(best_scale(variance, error2))
    return variance, error2


@dataclass(frozen=True)
class Scales:
    """Two factors that calibrate a variance: by the highest likelihood, and so that 68 % of the errors are covered."""

    likelihood: float
    coverage_68: float


def _best_scales(run: Run, predictors: Sequence[AnyPredictor]) -> dict[tuple[Kind, str], dict[str, Scales]]:
    """Return the scales of each predictor on the held-back views and on the surface, by `_fitted_on` and subset."""
    return {
        (_fitted_on(kind), subset): {
            p.name: _scales_of(*predicted(p, arrays, pixels)) for p in predictors if p.quantity == kind.quantity
        }
        for kind, arrays in run.samples.items()
        if kind.views != AWAY
        for subset, pixels in subsets(kind, arrays).items()
    }


def _scales_of(variance: NDArray[np.float32], error2: NDArray[np.float32]) -> Scales:
    return Scales(best_scale(variance, error2, EPSILON), z_scores(variance, error2, EPSILON)["z_68"] ** 2)


def _transferred(scales: Sequence[Mapping[str, Scales]]) -> dict[str, Scales]:
    """Return one pair of temperatures for each predictor; sequences without finite, positive scales do not count."""
    found = dict[str, Scales]()
    for name in dict.fromkeys(name for scale in scales for name in scale):
        some = np.array([(s[name].likelihood, s[name].coverage_68) for s in scales if name in s])
        some = some[(np.isfinite(some) & (some > 0)).all(1)]
        if len(some):
            found[name] = Scales(float(some[:, 0].mean()), float(np.exp(np.log(some[:, 1]).mean())))
    return found


def _score(
    kind: Kind,
    arrays: Arrays,
    pixels: NDArray[np.bool_],
    predictors: Sequence[AnyPredictor],
    temperatures: Mapping[str, Scales],
) -> dict[str, Any]:
    """Return the scores of each predictor on some pixels."""
    rows = dict[str, Any]()
    for p in predictors:
        if p.quantity == kind.quantity:
            # A temperature transfers a scale between sequences. A scaled predictor already has the best one, and a
            # calibrated one brings its own from the probe views of its run.
            fitted = not (p.scaled or p.calibrated)
            temperature = temperatures.get(p.name, Scales(1.0, 1.0)) if fitted else Scales(1.0, 1.0)
            rows[p.name] = _scores_of(*predicted(p, arrays, pixels), temperature, EPSILON)
    return rows


def _scores_of(
    variance: NDArray[np.float32], error2: NDArray[np.float32], temperature: Scales, epsilon: float
) -> dict[str, Any]:
    """Return the scores of a variance: rank, before and after the temperature, and the NLL at its own best scale."""
    own = best_scale(variance, error2, epsilon)
    scaled = variance.astype(np.float64).clip(min=0.0) + epsilon
    return {
        **ranking_scores(variance, error2),
        "before": calibration_scores(variance, error2, epsilon),
        "temperature": temperature.likelihood,
        "after": calibration_scores(temperature.likelihood * scaled, error2, 0.0),
        "temperature_68": temperature.coverage_68,
        "after_68": calibration_scores(temperature.coverage_68 * scaled, error2, 0.0),
        "best_scale": own,
        "nll_at_best_scale": gaussian_nll(own * scaled, error2, 0.0) if own > 0 else float("nan"),
        "mean_variance": float(variance.mean()) if len(variance) else float("nan"),
        "mean_squared_error": float(error2.mean()) if len(error2) else float("nan"),
    }


def best_scale(variance: NDArray[np.floating], squared_error: NDArray[np.floating], epsilon: float = EPSILON) -> float:
    """Return the factor T with which T (V+ε) has the highest Gaussian likelihood, the temperature of a calibration."""
    return z_scores(variance, squared_error, epsilon)["z_rms"] ** 2


def ranking_scores(variance: NDArray[np.floating], squared_error: NDArray[np.floating]) -> dict[str, float]:
    """Return the scores that only depend on the order of V: ause, spearman, of errors averaged over their channels."""
    mean = over_channels(variance, squared_error)
    return {"ause": ause(variance, mean), "spearman": spearman(variance, mean)}


def sparsification_charts(kind: Kind, arrays: Arrays, predictors: Sequence[AnyPredictor] = EVERY) -> list[Chart]:
    """Return charts of the RMSE after the pixels of largest variance are removed.

    Each chart compares the calibrated predictors and the true error with a few others. A curve ends where it rises more
    than `HEADROOM` above its start.
    """
    wanted = [p for p in predictors if p.quantity == kind.quantity]
    ours, others = [p for p in wanted if p.calibrated], [p for p in wanted if not p.calibrated]
    quantity, y_label, removed = QUANTITIES[kind.quantity]
    title = f"{quantity}, {MAP_TITLES.get(kind.map, kind.map)}, {VIEW_TITLES.get(kind.views, kind.views)}"
    x_label = f"{removed} removed, largest predicted variance first, %"
    error2 = over_channels(arrays["alpha"], arrays["squared_error"])
    top = HEADROOM * float(np.sqrt(error2.mean()))

    def curve(name: str, order_by: NDArray[np.float32], colour: int, width: float = 2.0) -> Curve:
        rmse = sparsification(order_by, error2)
        points = np.stack([np.arange(len(rmse)), np.where(rmse <= top, rmse, np.nan)], 1)
        return Curve(name, points, colour, width=width)

    def of(predictor: AnyPredictor, colour: int, width: float = 2.0) -> Curve:
        return curve(predictor.name, arrays[f"variance {predictor.name}"], colour, width)

    best = [*(of(p, ACCENT, 3.0) for p in ours), curve("true error", error2, FAINT)]
    groups = [others[first : first + len(CURVES)] for first in range(0, len(others), len(CURVES))] or [[]]
    return [
        Chart(
            title, x_label, y_label, [*(of(p, colour) for p, colour in zip(some, CURVES, strict=False)), *best],
            y_limits=(0.0, top),
        )
        for some in groups
    ]  # fmt: skip
