"""Fit the exposure of a recorded image to the rendering of the map, in closed form."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.data.exposure import NEUTRAL
from sigmasplat.fit.target import Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

EVERY = 47
"""Every 47th pixel is used: 1600 pixels of a 320×240 image determine two numbers per channel well."""
OPAQUE, DARKEST, BRIGHTEST = 0.9, 0.01, 0.98
"""Pixels are used if the map covers them, and no channel of the recorded colour is black or saturated."""
OUTLIER = 0.03
"""Residuals above this count less: weight 1 / (|r| + OUTLIER), the L1 norm for large ones."""
PRIOR = np.diag([0.002, 0.01])
"""Information of the prior (neutral exposure) per pixel. It decides for images with hardly any contrast."""


def fit_exposure(view: View, target: Target) -> Matrix:
    """Return the exposure [3, 2] with which a view's rendered colours are nearest to those of an image, by one step of
    iteratively reweighted least squares; neutral if no pixel can be compared."""
    rendered, recorded = (_sampled(plane) for plane in (view.sums[:3], target.color))
    known = (_sampled(view.alpha[None])[0] > OPAQUE) & (recorded.min(0) > DARKEST) & (recorded.max(0) < BRIGHTEST)
    if not known.any():
        return NEUTRAL.copy()
    r, c = rendered[:, known], recorded[:, known]
    w = 1.0 / (np.abs(c - r) + OUTLIER)
    w /= w.sum(1, keepdims=True)
    rr, r1, rc, c1 = ((w * product).sum(1) for product in (r * r, r, r * c, c))
    information = np.moveaxis(np.array([[rr, r1], [r1, np.ones(3)]]), -1, 0) + PRIOR
    return np.linalg.solve(information, (np.stack([rc, c1], -1) + PRIOR @ NEUTRAL[0])[..., None])[..., 0]


def _sampled(planes: Tensor) -> NDArray[np.float64]:
    """Return every `EVERY`-th pixel of planes [C, rows, columns] as [C, P]."""
    return np.asarray(planes.reshape(len(planes), -1)[:, ::EVERY].cpu(), np.float64)
