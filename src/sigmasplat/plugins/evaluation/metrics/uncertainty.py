"""Score a predicted variance against the squared error: rank correlation, likelihood, coverage, sparsification.

Every function takes two arrays: predicted variance V [P] and squared error r² [P], both in colour² (or m²). They hold
valid pixels only. Functions of calibration also take squared errors [P, C] of the C channels of a colour, with V their
common variance: the share of errors inside an interval is then of errors of single channels. The mean over independent
channels is closer to V than any of them, so that its coverage would be wrong even for the true V.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, spearmanr

Values = NDArray[np.floating[Any]]

EPSILON = 1e-6
"""VarSplat's ε, colour²: keeps the logarithm and the division finite where V is 0."""

LEVELS = np.arange(0.05, 1.0, 0.1)
"""The ten nominal coverages of AUCE: 5 %, 15 %, … 95 %."""


def spearman(variance: Values, squared_error: Values) -> float:
    """Return the rank correlation of V and r² in [−1, 1]; nan if one is constant or with fewer than 2 values."""
    v, e = variance.ravel(), squared_error.ravel()
    if v.size < 2 or v.min() == v.max() or e.min() == e.max():
        return float("nan")
    return float(spearmanr(v, e).statistic)


def gaussian_nll(variance: Values, squared_error: Values, epsilon: float = EPSILON) -> float:
    """Return the mean of ½ r²/(V+ε) + ½ log(V+ε) (VarSplat §2, NLL_x, without the constant ½ log 2π).

    A negative V counts as 0.
    """
    v = _positive(variance, squared_error, epsilon)
    return float(np.mean(0.5 * squared_error / v + 0.5 * np.log(v))) if v.size else float("nan")


def coverage(variance: Values, squared_error: Values, levels: Values, epsilon: float = EPSILON) -> Values:
    """Return the share of errors inside the central interval of a Gaussian of variance V+ε, for each nominal level.

    levels [L] in (0, 1). The result [L] equals them if V is right and the errors are Gaussian; nan without pixels.
    """
    if not squared_error.size:
        return np.full(len(levels), np.nan)
    z2 = (squared_error / _positive(variance, squared_error, epsilon)).ravel()
    limits = norm.ppf(0.5 + 0.5 * levels) ** 2
    counts = np.bincount(np.searchsorted(limits, z2, side="left"), minlength=len(limits) + 1)
    return np.asarray(np.cumsum(counts)[: len(limits)] / z2.size)


def auce(variance: Values, squared_error: Values, epsilon: float = EPSILON) -> float:
    """Return the mean of |coverage − nominal| over `LEVELS` (Gustafsson et al. 2020); nan without pixels.

    0: every interval contains its share of the errors. The largest possible value is 0.5.
    """
    return float(np.abs(coverage(variance, squared_error, LEVELS, epsilon) - LEVELS).mean())


def sparsification(order_by: Values, squared_error: Values, steps: int = 100) -> NDArray[np.float64]:
    """Return the RMSE [steps] after removing the share 0, 1/steps, … of pixels with the highest `order_by`."""
    e = squared_error.ravel().astype(np.float64)
    rising = e[np.argsort(order_by.ravel(), kind="stable")]
    kept = np.ceil(len(e) * (1.0 - np.arange(steps) / steps)).astype(int).clip(1)
    return np.asarray(np.sqrt(np.cumsum(rising)[kept - 1] / kept))


def ause(variance: Values, squared_error: Values, steps: int = 100) -> float:
    """Return the area between the sparsification curves by V and by the true error, as a share of the RMSE (Ilg 2018).

    0: V ranks the pixels exactly like the error. A random V removes no error on average. nan without pixels, or if
    all errors are 0.
    """
    if not squared_error.size or not float(squared_error.max()) > 0.0:
        return float("nan")
    by_variance = sparsification(variance, squared_error, steps)
    by_error = sparsification(squared_error, squared_error, steps)
    return float(np.mean(by_variance - by_error) / by_error[0])


def z_scores(variance: Values, squared_error: Values, epsilon: float = EPSILON) -> dict[str, float]:
    """Return the root mean square of the z-scores r/√(V+ε), and z_68: 68.3 % of |z| are below it.

    Both are 1 for a right V and Gaussian errors. Few large errors raise the first one only. nan without pixels.
    """
    if not squared_error.size:
        return {"z_rms": float("nan"), "z_68": float("nan")}
    z2 = squared_error / _positive(variance, squared_error, epsilon)
    return {"z_rms": float(np.sqrt(z2.mean())), "z_68": float(np.sqrt(np.quantile(z2, 0.6827)))}


def calibration_scores(variance: Values, squared_error: Values, epsilon: float = EPSILON) -> dict[str, float]:
    """Return the scores that a scale of V changes: nll, auce, coverage_68, coverage_95, z_rms, z_68."""
    at_68, at_95 = coverage(variance, squared_error, np.array([0.6827, 0.95]), epsilon)
    return {
        "nll": gaussian_nll(variance, squared_error, epsilon), "auce": auce(variance, squared_error, epsilon),
        "coverage_68": float(at_68), "coverage_95": float(at_95), **z_scores(variance, squared_error, epsilon),
    }  # fmt: skip


def score(variance: Values, squared_error: Values) -> dict[str, Any]:
    """Return all scores of this module, the means of V and r², and the number of pixels, as plain values."""
    return {
        "pixels": int(variance.size), "spearman": spearman(variance, squared_error),
        "nll": gaussian_nll(variance, squared_error), "ause": ause(variance, squared_error),
        "mean_variance": float(variance.mean()) if variance.size else float("nan"),
        "mean_squared_error": float(squared_error.mean()) if variance.size else float("nan"),
    }  # fmt: skip


def over_channels(variance: Values, squared_error: Values) -> Values:
    """Return the squared errors averaged over their channels, in the shape of the variance."""
    return squared_error.mean(-1) if squared_error.ndim > variance.ndim else squared_error


def _positive(variance: Values, squared_error: Values, epsilon: float) -> Values:
    """Return V+ε, at least ε, in the shape that divides the squared errors: with channels [P, 1], else [P]."""
    v = np.maximum(variance.astype(np.float64), 0.0) + epsilon
    return v[..., None] if squared_error.ndim > variance.ndim else v
