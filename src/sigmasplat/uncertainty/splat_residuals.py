"""Measure the variance of each splat's residuals at the keyframes, in closed form: no gradient steps, no learning rate.

A residual is shared among the splats of its pixel by their weights: r_i² is (Σ_p w_ip |e_p| / Σ_p w_ip)², times the
factor of a Gaussian. Each keyframe is rendered once, forwards and backwards.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.map_uncertainty import Background
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.backend import on_device
from sigmasplat.uncertainty.blended_values import blend_values
from sigmasplat.uncertainty.predictive import COVERED, directions_toward

SQUARE_OF_MEAN = (3.0 * math.pi / 8.0, math.pi / 2.0)
"""Variance over squared mean absolute residual, of colour and of depth: that of independent Gaussian channels."""
PSEUDO_PIXELS = 1.0
"""Weight of the mean residual of the map in the variance of a splat, in pixels: it decides for splats hardly seen."""
FARTHEST_M = 0.3
"""Limit of a depth residual in the mean of a splat's residuals, m, in a room: beyond it the reading is of another
surface."""


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
    means = (absolute + PSEUDO_PIXELS * usual) / (weights + PSEUDO_PIXELS)
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
