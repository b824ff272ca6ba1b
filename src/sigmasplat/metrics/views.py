"""Sum up the scores of many views: averages per kind, and one judgement of V over all their pixels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.metrics import uncertainty
from sigmasplat.metrics.panels import COVERED_ALPHA, View

PIXELS_PER_VIEW = 20_000
"""Every k-th valid pixel of a view goes into the uncertainty scores, so that their sorts stay short."""


def sample(view: View) -> NDArray[np.float32]:
    """Return (V, squared error, alpha) [3, P] of every k-th pixel with a reading, at most `PIXELS_PER_VIEW`."""
    values = np.stack([view.uncertainty[view.valid], view.squared_error[view.valid], view.alpha[view.valid]])
    return values[:, :: max(1, -(-values.shape[1] // PIXELS_PER_VIEW))]


def average(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Average each score over the views that have it, None where none has; `views` counts them."""
    columns = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
    return {"views": len(rows)} | {name: _mean(column) for name, column in columns.items()}


def judge(samples: list[NDArray[np.float32]]) -> dict[str, Any] | None:
    """Score V against the squared error over all sampled pixels (`uncertainty.score`); None without any pixel.

    Adds spearman_covered (only pixels where the map has a surface) and spearman_per_view (mean of the views' own).
    """
    if not sum(part.shape[1] for part in samples):
        return None
    variance, squared_error, alpha = np.concatenate(samples, axis=1)
    covered = alpha > COVERED_ALPHA
    return uncertainty.score(variance, squared_error) | {
        "spearman_covered": uncertainty.spearman(variance[covered], squared_error[covered]),
        "spearman_per_view": _mean(np.array([uncertainty.spearman(part[0], part[1]) for part in samples])),
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the values that exist, None if none does."""
    existing = values[~np.isnan(values)]
    return float(existing.mean()) if len(existing) else None
