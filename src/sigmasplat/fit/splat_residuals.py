"""Measure the variance of each splat's residuals at the keyframes, in closed form: no gradient steps, no learning rate.

The variance of a pixel's error is modelled as Σ_i w_ip r_i² plus the background's share. The likelihood of all pixels
is raised by multiplicative updates (Févotte et al. 2009, Itakura–Saito NMF): r_i² times Σ_p w_ip e_p²/V_p² over
Σ_p w_ip/V_p. Each update renders every keyframe once, forwards and backwards.
"""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.fit.target import Keyframe
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.model.map_uncertainty import Background
from sigmasplat.render.blended_values import BlendedValues, blend_values
from sigmasplat.render.predictive import COVERED, directions_toward
from sigmasplat.render.render import on_device

UPDATES = 2
PSEUDO_PIXELS = 1.0
"""Weight of the mean residual of the map in the variance of a splat, in pixels: it decides for splats hardly seen."""
LIMIT = 3.0
"""Errors above this multiple of their predicted standard deviation count as this multiple: they are not noise."""
FLOOR = (1e-5, 1e-6)
"""Least variance of a pixel, colour² and m²."""
FARTHEST_M = 0.3
"""Limit of a depth residual in the mean of a splat's residuals, m: beyond it the reading is of another surface."""
CHANGE = 4.0
"""An update changes a variance at most by this factor."""


def background_of(keyframes: Iterable[Keyframe]) -> Background:
    """Return mean and variance of the colours and the variance of the depths of keyframes, over every 7th pixel."""
    colors, depths = list[Tensor](), list[Tensor]()
    for keyframe in keyframes:
        colors.append(keyframe.target.image.reshape(-1, 3)[::7].double())
        depth = keyframe.target.depth_image.reshape(-1)[::7].double()
        depths.append(depth[depth > 0])
    color, depth = torch.cat(colors), torch.cat(depths)
    red, green, blue = color.mean(0).tolist()
    depth_variance = float(depth.var(correction=0)) if len(depth) else 1.0
    return Background((red, green, blue), float(color.var(0, correction=0).mean()), depth_variance)


def splat_residuals(
    field: GaussianField,
    keyframes: Iterable[Keyframe],
    background: Background,
    options: RenderConfig,
    backend: str,
    updates: int = UPDATES,
) -> Tensor:
    """Return the variances and the mean viewing direction of each splat [N, 6] (`SPLAT_COLUMNS`) from keyframes with
    poses in the map's frame.

    The first two start at the squared mean of the absolute residuals, which outliers hardly change. The third is
    m² + v/n: m is the mean of the splat's depth residuals, v their variance about it, n the number of readings.
    """
    field = on_device(field, backend)
    sums = torch.zeros(len(field), 4, dtype=torch.float64)
    moments = torch.zeros(len(field), 2, dtype=torch.float64)
    start, directions = torch.zeros(len(field), 2), torch.zeros(len(field), 3, dtype=torch.float64)
    for seen, errors, known, off_m, toward in _residuals(field, keyframes, start, options, backend):
        limited = off_m.clamp(-FARTHEST_M, FARTHEST_M)
        planes = torch.cat([errors.sqrt() * known, known, torch.stack([limited, limited.square()], -1)], -1)
        found = seen.gather(planes).cpu().double()
        sums, moments = sums + found[:, :4], moments + found[:, 4:]
        directions += found[:, 2:3] * toward
    usual = sums[:, :2].sum(0) / sums[:, 2:].sum(0).clamp(min=1e-12)
    variances = ((sums[:, :2] + PSEUDO_PIXELS * usual) / (sums[:, 2:] + PSEUDO_PIXELS)).square().clamp(min=1e-12)
    first, prior = variances, torch.tensor([background.color_variance, background.depth_variance_m2])
    readings, directions = sums[:, 3], directions / sums[:, 2:3].clamp(min=1e-12)
    mean, square = (moments / readings.clamp(min=1e-3)[:, None]).T
    own = mean**2 + (square - mean**2).clamp(min=0.0) / readings.clamp(min=1.0)
    for _ in range(updates):
        sums = torch.zeros_like(sums)
        for seen, errors, known, _, _ in _residuals(field, keyframes, variances.float(), options, backend):
            share, missing = _share(seen), (1.0 - seen.alpha).clamp(min=0.0)[..., None]
            V = seen.values * share + missing * prior.to(missing) + missing.new_tensor(FLOOR)
            limited = torch.minimum(errors, LIMIT**2 * V)
            sums += (
                seen.gather(torch.cat([limited / V**2, 1.0 / V], -1) * (known * share).repeat(1, 1, 2)).cpu().double()
            )
        above, below = sums[:, :2] + PSEUDO_PIXELS * first / variances**2, sums[:, 2:] + PSEUDO_PIXELS / variances
        variances = variances * (above / below).clamp(1.0 / CHANGE, CHANGE)
    return torch.cat([variances, own[:, None], directions], 1).float()


def _residuals(
    field: GaussianField, keyframes: Iterable[Keyframe], values: Tensor, options: RenderConfig, backend: str
) -> Iterator[tuple[BlendedValues, Tensor, Tensor, Tensor, Tensor]]:
    """Yield each keyframe rendered with values [N, 2]: squared errors [H, W, 2] of colour and depth, which are known,
    the error of depth [H, W] m, 0 if not known, and unit vectors from the splats to its camera [N, 3]."""
    for keyframe in keyframes:
        target, T_camera_map = keyframe.target, se3.inverse(keyframe.T_world_camera)
        seen = blend_values(field, target.camera, T_camera_map, values, options, backend, gather=True)
        image, depth = (plane.to(seen.alpha) for plane in (target.image, target.depth_image))
        errors, known = squared_errors(seen.color, seen.depth, seen.alpha, image, depth)
        off_m = (seen.depth / seen.alpha.clamp(min=COVERED) - depth) * known[..., 1]
        yield seen, errors, known, off_m, directions_toward(field, keyframe.T_world_camera).cpu().double()


def squared_errors(
    color: Tensor, depth: Tensor, alpha: Tensor, image: Tensor, depth_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the squared errors [H, W, 2] of rendered colour Σwc (mean over channels) and depth Σwz against an image
    and its depth (m², 0 if not known), and 1 where each error is known, else 0."""
    known = (depth_m > 0) & (alpha > COVERED)
    error_m = torch.where(known, depth / alpha.clamp(min=COVERED) - depth_m, 0.0)
    errors = torch.stack([(color.clamp(0.0, 1.0) - image).square().mean(-1), error_m.square()], -1)
    return errors, torch.stack([torch.ones_like(alpha), known.to(alpha)], -1)


def _share(seen: BlendedValues) -> Tensor:
    """Return the factor [H, W, 2] between Σ w r² and the variance of a pixel: 1 for colour, 1/A for depth."""
    return torch.stack([torch.ones_like(seen.alpha), 1.0 / seen.alpha.clamp(min=COVERED)], -1)
