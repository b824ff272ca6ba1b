"""Score how honest a run is about its path: undeclared wrong poses, and the predicted probability of a wrong pose."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

OFF_M = 0.05
"""`p_off` is the probability that a pose is off by more than this."""
SILENT_M = 0.10
"""A valid pose that is off by more than this is a silent failure."""
BINS = 10

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]


def score_failures(error_m: Values, p_off: Values, valid: Mask) -> dict[str, Any]:
    """Score the frames of a run.

    error_m [F]: distance from the true position after the alignment of the ATE, nan if it is not known; p_off [F]: the
    predicted probability that it is above 5 cm, nan if it is not known; valid [F]: whether the pose is valid.

    `silent_rows` are the rows of the valid frames that are off by more than 10 cm. `auroc` and `brier` judge p_off
    on all frames with both values; both are nan if there is no such frame, and auroc also if all or none are off.
    """
    silent = valid & (error_m > SILENT_M)
    known = np.isfinite(error_m) & np.isfinite(p_off)
    off, p = error_m[known] > OFF_M, p_off[known]
    return {
        "frames": int(np.isfinite(error_m).sum()),
        "off": int((error_m > OFF_M).sum()),
        "silent": int(silent.sum()),
        "silent_rows": np.flatnonzero(silent).tolist(),
        "auroc": auroc(p, off),
        "brier": brier(p, off),
        "calibration": calibration(p, off),
    }


def auroc(p: Values, off: Mask) -> float:
    """Return the area under the ROC curve: how often p is higher for a frame that is off than for one that is not.

    Ties count one half. ½: p is random; nan if all or none are off.
    """
    positive, negative = int(off.sum()), int((~off).sum())
    if not positive or not negative:
        return float("nan")
    ranks = rankdata(p)[off].sum() - positive * (positive + 1) / 2.0
    return float(ranks / (positive * negative))


def brier(p: Values, off: Mask) -> float:
    """Return the mean of (p − off)² (Brier 1950); 0 is perfect, nan without values."""
    return float(np.mean((p - off) ** 2)) if len(p) else float("nan")


def calibration(p: Values, off: Mask, bins: int = BINS) -> list[dict[str, float]]:
    """Return the mean p and the share of frames that are off, for each non-empty bin of p of equal width."""
    bin_of = np.minimum((p * bins).astype(int), bins - 1)
    return [
        {"predicted": float(p[at].mean()), "observed": float(off[at].mean()), "frames": int(at.sum())}
        for at in (bin_of == number for number in np.unique(bin_of))
    ]
