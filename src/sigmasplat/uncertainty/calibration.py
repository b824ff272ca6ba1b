"""Fit the weights of the parts of a predicted variance to squared errors, by maximum likelihood; standard deviations of
single splats by these weights.
"""

from collections.abc import Collection, Iterable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.map_uncertainty import MapUncertainty, SplatStd
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.backend import on_device
from sigmasplat.uncertainty.predictive import COVERED, predicted, variance_parts

Values = NDArray[np.float64]

PIXELS_PER_VIEW = 30.0
"""Number of independent pixels that a view counts as: errors of neighbouring pixels are correlated."""
PULL = 1.0
"""Standard deviation of the logarithm of a weight about the weight that it is pulled to."""
FIRM_PULL = 0.1
"""The same for weights that the views of a run say little about."""
RANGE = 9.0
"""A weight changes at most by the exponential of this."""
REWEIGHTED = 6
"""Number of fits with errors limited by the last fit."""


def fit_weights(
    parts: Mapping[str, Values],
    squared_error: Values,
    pulled_to: Mapping[str, float],
    views: int,
    limit: float = np.inf,
    firm: Collection[str] = (),
) -> dict[str, float]:
    """Return the weights a > 0 that maximise the Gaussian likelihood of errors with variance V = Σ_k a_k V_k, and a
    log-normal prior about `pulled_to`.

    parts: planes V_k [P] by name; squared_error [P]; views: number of views that the pixels come from. Without pixels
    the weights are those of `pulled_to`. limit: squared errors above limit² V count as limit² V, so that the weights
    describe most pixels rather than the largest errors. firm: weights that hardly move from `pulled_to`.
    """
    names = list(pulled_to)
    center = np.log([pulled_to[name] for name in names])
    if not len(squared_error):
        return dict(pulled_to)
    pull = np.array([FIRM_PULL if name in firm else PULL for name in names])
    planes = np.stack([parts[name] for name in names]).astype(np.float64)
    strength, logs, errors = PIXELS_PER_VIEW * views, center, squared_error.astype(np.float64)
    for _ in range(REWEIGHTED if np.isfinite(limit) else 1):
        logs = _maximised(planes, errors, center, logs, strength, pull)
        if np.isfinite(limit):
            errors = np.minimum(squared_error, limit**2 * (np.exp(logs) @ planes))
    return dict(zip(names, np.exp(logs).tolist(), strict=True))


def _maximised(planes: Values, errors: Values, center: Values, start: Values, strength: float, pull: Values) -> Values:
    """Return the logarithms of the best weights."""

    def cost(logs: Values) -> tuple[float, Values]:
        weights = np.exp(logs)
        variance = weights @ planes
        ratio, off = errors / variance, (logs - center) / pull**2
        value = strength * 0.5 * np.mean(ratio + np.log(variance)) + 0.5 * float(off @ (logs - center))
        slope = strength * 0.5 * (planes @ ((1.0 - ratio) / variance)) / len(errors) * weights
        return float(value), slope + off

    bounds = [(c - RANGE, c + RANGE) for c in center]
    return np.asarray(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x)


PSEUDO_PIXELS = 0.003
"""Weight of the background's variance, in pixels: it decides for splats that no keyframe shows. A larger weight would
count for small splats that one keyframe shows."""
LEAST = 1e-12
"""Least variance of a pixel, colour² and m²: its logarithm is finite."""


def splat_std(
    field: GaussianField,
    uncertainty: MapUncertainty,
    keyframes: Iterable[Keyframe],
    options: RenderConfig,
    backend: str,
) -> SplatStd:
    """Return the standard deviations of a map's splats from keyframes with poses in the map's frame.

    The variance of splat i is the weighted geometric mean of the variance V_p that the map predicts for pixels,
    exp(Σ_p w_ip log V_p / Σ_p w_ip): of depth over the pixels that the map covers, of colour over all pixels. Few
    pixels at silhouettes have a variance of depth that is thousands of times larger, and would decide an arithmetic
    mean. Each keyframe is rendered once, forwards and backwards.
    """
    field = on_device(field, backend)
    sums = torch.zeros(len(field), 4, dtype=torch.float64)
    for keyframe in keyframes:
        T_camera_map = se3.inverse(keyframe.T_world_camera)
        known = uncertainty.splats, uncertainty.background, keyframe.target.camera, T_camera_map
        parts = variance_parts(field, *known, options, backend, gather=True)
        found, covered = predicted(parts, uncertainty.calibration), (parts.alpha > COVERED).to(parts.alpha)
        logs = [V.clamp(min=LEAST).log() for V in (found.depth_std_m.square(), found.color)]
        planes = [covered * logs[0], logs[1], covered, torch.ones_like(covered)]
        sums += parts.seen.gather(torch.stack(planes, -1)).cpu().double()
    background = uncertainty.background
    prior = sums.new_tensor([background.depth_variance_m2, background.color_variance]).clamp(min=LEAST).log()
    mean_log = (sums[:, :2] + PSEUDO_PIXELS * prior) / (sums[:, 2:] + PSEUDO_PIXELS)
    return SplatStd(*(0.5 * mean_log).exp().float().unbind(1))
