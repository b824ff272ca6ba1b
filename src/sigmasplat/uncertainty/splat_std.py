"""Compute the calibrated standard deviation of each splat: what the map predicts for the pixels that show the splat."""

from collections.abc import Iterable

import torch

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.map_uncertainty import MapUncertainty, SplatStd
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.backend import on_device
from sigmasplat.uncertainty.predictive import COVERED, predicted, variance_parts

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
