"""Variances of splats: of their residuals at the keyframes, in closed form (no gradient steps, no learning rate);
standard deviations by weights that are fitted to squared errors by maximum likelihood.

A residual is shared among the splats of its pixel by their weights: r_i² is (Σ_p w_ip |e_p| / Σ_p w_ip)², times the
factor of a Gaussian. Each keyframe is rendered once, forwards and backwards.
"""

import math
from collections.abc import Collection, Iterable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.backend import on_device
from sigmasplat.uncertainty.map_uncertainty import Background, MapUncertainty, SplatStd
from sigmasplat.uncertainty.predictive import COVERED, blend_values, directions_toward, predicted, variance_parts

SQUARE_OF_MEAN = (3.0 * math.pi / 8.0, math.pi / 2.0)
"""Variance over squared mean absolute residual, of colour and of depth: that of independent Gaussian channels."""
RESIDUAL_PIXELS = 1.0
"""Weight of the mean residual of the map in the variance of a splat, in pixels: it decides for splats hardly seen."""
FARTHEST_M = 0.3
"""Limit of a depth residual in the mean of a splat's residuals, m, in a room: beyond it is another surface."""


def background_of(keyframes: Iterable[Keyframe]) -> Background:
    """Return mean and variance of the colours and the variance of the depths of keyframes, over every 7th pixel."""
    sums = torch.zeros(3, 4, dtype=torch.float64)  # number, sum and sum of squares of red, green, blue and depth
    for keyframe in keyframes:
        color, depth = keyframe.target.image.reshape(-1, 3), keyframe.target.depth_image.reshape(-1, 1)
        values = torch.cat([color, depth], 1)[::7].double()
        known = torch.cat([torch.ones_like(values[:, :3]), values[:, 3:] > 0], 1)
        sums += torch.stack([known.sum(0), values.sum(0), values.square().sum(0)])
    mean, square = sums[1:] / sums[0].clamp(min=1.0)
    variance, (red, green, blue, _) = (square - mean.square()).clamp(min=0.0), mean.tolist()
    depth_variance = float(variance[3]) if sums[0, 3] else 1.0
    return Background((red, green, blue), float(variance[:3].mean()), depth_variance)


def splat_residuals(field: GaussianField, keyframes: Iterable[Keyframe], options: RenderConfig, backend: str) -> Tensor:
    """Return the variances and the mean viewing direction of each splat [N, 6] (`SPLAT_COLUMNS`) from keyframes with
    poses in the map's frame.

    The first two are from mean absolute residuals, which outliers change less than mean squares. The third is
    m² + v/n: m is the mean of the splat's depth residuals, v their variance about it, n the number of readings.
    """
    field = on_device(field, backend)
    sums, directions = torch.zeros(len(field), 6, dtype=torch.float64), torch.zeros(len(field), 3, dtype=torch.float64)
    nothing = torch.zeros(len(field), 0)
    for keyframe in keyframes:
        target, T_camera_map = keyframe.target, se3.inverse(keyframe.T_world_camera)
        seen = blend_values(field, target.camera, T_camera_map, nothing, options, backend, gather=True)
        image, depth = (plane.to(seen.alpha) for plane in (target.image, target.depth_image))
        errors, known = squared_errors(seen.color, seen.depth, seen.alpha, image, depth)
        off_m = (seen.depth / seen.alpha.clamp(min=COVERED) - depth) * known[..., 1]
        farthest_m = FARTHEST_M * options.scene_scale
        off_m = off_m.clamp(-farthest_m, farthest_m)[..., None]
        found = seen.gather(torch.cat([errors.sqrt() * known, known, off_m, off_m.square()], -1)).cpu().double()
        sums += found
        rows = seen.rows
        toward = directions_toward(field.params[rows, COLUMNS["means"]].detach(), keyframe.T_world_camera)
        directions[rows.cpu()] += found[rows.cpu(), 2:3] * toward.cpu().double()
    absolute, weights, moments = sums[:, :2], sums[:, 2:4], sums[:, 4:]
    usual = absolute.sum(0) / weights.sum(0).clamp(min=1e-12)
    means = (absolute + RESIDUAL_PIXELS * usual) / (weights + RESIDUAL_PIXELS)
    variances = (means.square() * means.new_tensor(SQUARE_OF_MEAN)).clamp(min=1e-12)
    readings = weights[:, 1]
    mean, square = (moments / readings.clamp(min=1e-3)[:, None]).T
    own = mean**2 + (square - mean**2).clamp(min=0.0) / readings.clamp(min=1.0)
    return torch.cat([variances, own[:, None], directions / weights[:, :1].clamp(min=1e-12)], 1).float()


def squared_errors(
    color: Tensor, depth: Tensor, alpha: Tensor, image: Tensor, depth_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the squared errors [H, W, 2] of rendered colour Σwc (mean over channels) and depth Σwz against an image
    and its depth (m², 0 if not known), and 1 where each error is known, else 0."""
    known = (depth_m > 0) & (alpha > COVERED)
    error_m = torch.where(known, depth / alpha.clamp(min=COVERED) - depth_m, 0.0)
    errors = torch.stack([(color.clamp(0.0, 1.0) - image).square().mean(-1), error_m.square()], -1)
    return errors, torch.stack([torch.ones_like(alpha), known.to(alpha)], -1)


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
    parts: Mapping[str, Values], squared_error: Values, pulled_to: Mapping[str, float], views: int,
    limit: float = np.inf, firm: Collection[str] = (),
) -> dict[str, float]:  # fmt: skip
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
    field: GaussianField, uncertainty: MapUncertainty, keyframes: Iterable[Keyframe], options: RenderConfig,
    backend: str,
) -> SplatStd:  # fmt: skip
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
