"""Fit the exposure of a recorded image to the rendering of the map, in closed form."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.fit.target import Target
from sigmasplat.model.exposure import NEUTRAL
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

EVERY = 7
"""Every 7th pixel is used: 11 000 pixels of a 320×240 image determine two numbers per channel well."""
OPAQUE, DARKEST, BRIGHTEST = 0.9, 0.01, 0.98
"""Pixels are used if the map covers them, and no channel of the recorded colour is black or saturated."""
OUTLIER = 0.03
"""Residuals above this count less: weight 1 / (|r| + OUTLIER), the L1 norm for large ones."""
PRIOR = np.diag([0.002, 0.01])
"""Information of the prior (neutral exposure) per pixel. It decides for images with hardly any contrast."""


def fit_exposure(view: View, target: Target) -> Matrix:
    """Return the exposure [3, 2] with which a view's rendered colours are nearest to those of an image; neutral if no
    pixel can be compared."""
    rows = np.flatnonzero(np.asarray(view.alpha.cpu()).ravel()[::EVERY] > OPAQUE)
    rendered, recorded = (_sampled(plane)[:, rows] for plane in (view.sums[:3], target.color))
    known = (recorded.min(0) > DARKEST) & (recorded.max(0) < BRIGHTEST)
    if not known.any():
        return NEUTRAL.copy()
    return np.stack([_fit(*pair) for pair in zip(rendered[:, known], recorded[:, known], strict=True)])


def _sampled(planes: Tensor) -> NDArray[np.float64]:
    """Return every 7th pixel of colour planes, [3, P]."""
    return np.asarray(planes.reshape(3, -1)[:, ::EVERY].cpu(), np.float64)


def _fit(rendered: NDArray[np.float64], recorded: NDArray[np.float64]) -> Matrix:
    """Return (gain, offset) of one channel by one step of iteratively reweighted least squares."""
    weight = 1.0 / (np.abs(recorded - rendered) + OUTLIER)
    weight /= weight.sum()
    basis = np.stack([rendered, np.ones_like(rendered)])
    information = (weight * basis) @ basis.T + PRIOR
    return np.linalg.solve(information, (weight * basis) @ recorded + PRIOR @ NEUTRAL[0])
