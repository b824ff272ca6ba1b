"""The papers' tracking loss: pixel weights, the loss, and its gradient on a view's planes; reference maps of alignment
with the same weights.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.interface import ReferenceMaps
from sigmasplat.fit.target import Target, luma
from sigmasplat.render.kernels import variance_of
from sigmasplat.render.view import View


@torch.no_grad()
def uncertainty_weights(variance: Tensor, mask: Tensor, tau: float, weight_max: float, eps: float = 1e-6) -> Tensor:
    """Return pixel weights from the certainty of the map's colour (VarSplat §3, w̃), [H, W, 3], without gradient.

    w̃ = clamp(exp(−(log(V+ε) − median)/τ), 1/weight_max, weight_max) per channel. V [H, W, 3] is ≥ 0 up to rounding.
    The median is that of log(V+ε) over mask [H, W]; for an even count it is the lower of the two middle values. Every
    pixel gets a weight; the mask only selects the pixels of the median. An empty mask gives weight 1 everywhere.
    """
    log_variance, n = (variance.clamp(min=0.0) + eps).log(), mask.sum()
    known_first = torch.where(mask[..., None], log_variance, torch.inf).flatten(0, -2).sort(0).values
    # Indexed with a tensor, so that the host does not wait for a device to count the pixels.
    median = known_first.index_select(0, (n - 1).clamp(min=0)[None] // 2)
    weights = torch.exp((median - log_variance) / tau).clamp(1.0 / weight_max, weight_max)
    return torch.where(n > 0, weights, 1.0)


@torch.no_grad()
def outlier_mask(error: Tensor, valid: Tensor, factor: float) -> Tensor:
    """Return which valid pixels agree: |error| ≤ factor × its median over the valid pixels, bool [H, W] (VarSplat §3,
    CG-SLAM §6).

    error [H, W] of depth or colour, any sign; factor 0 = off. An error equal to the limit passes, so all pixels of a
    perfect render (median 0) pass. NaN never passes.
    """
    if factor <= 0.0 or not valid.any():
        return valid.clone()
    error = error.abs()
    known = error[valid].nan_to_num(nan=torch.inf)
    return valid & (error <= factor * known.median())


@dataclass(eq=False)
class PoseMaps:
    """The maps of a render that pose fits compare with a target."""

    color: Tensor
    depth: Tensor
    alpha: Tensor
    variance: Tensor | None

    @staticmethod
    def of(view: View) -> "PoseMaps":
        """Return the maps of a view's last forward pass, without padding."""
        h, w = view.camera.height, view.camera.width
        sums = view.sums[:, :h, :w].movedim(0, -1)
        variance = variance_of(sums) if sums.shape[-1] == 7 else None
        return PoseMaps(sums[..., :3], sums[..., 3], view.alpha[:h, :w], variance)


def agreement(maps: PoseMaps, target: Target) -> tuple[float, float]:
    """Return how well a render explains a depth image: the share of common pixels within 5 % or 5 cm, and the share of
    common pixels."""
    common = (maps.alpha > 0.5) & (target.depth_image > 0)
    surface = maps.depth / maps.alpha.clamp(min=0.5)
    close = (surface - target.depth_image).abs() < (0.05 * target.depth_image).clamp(min=0.05)
    n = int(common.sum())
    return float((close & common).sum()) / max(n, 1), n / max(target.valid_pixels, 1)


def per_value(weight: float, mask: Tensor, channels: int, average: str) -> float:
    """Return the weight of one error in the mean: over the pixels of the image, or over the used pixels and channels.

    Without a used pixel it is 0.
    """
    n = mask.numel() if average == "image" else channels * int(mask.sum())
    return weight / n if n else 0.0


@torch.no_grad()
def tracking_gradient(view: View, target: Target, config: TrackingConfig, exposure: Tensor) -> tuple[float, Tensor]:
    """Write ∂L_track/∂(color, depth) to the view's planes; return the loss and its gradient by exposure (a, b).

    L_track = Σ A³ M (λ_c w̃ |exp(a) Ĉ + b − C| + (1 − λ_c) |D̂ − D|). Here it is a mean over all pixels (VarSplat §3),
    or over the pixels used for colour and for depth (CG-SLAM §6). The choice of pixels M and their weights A³ and w̃
    have no gradient.
    """
    maps, c = PoseMaps.of(view), config
    gain, offset = exposure[0].exp(), exposure[1]
    color_error = gain * maps.color + offset - target.image
    depth_error = maps.depth - target.depth_image
    valid = target.depth_image > 0
    if c.alpha_above > 0:
        valid = valid & (maps.alpha > c.alpha_above)
    in_color = in_depth = outlier_mask(depth_error, valid, c.outlier_factor)
    if c.outlier_factor_color > 0:
        in_color = outlier_mask(color_error.abs().sum(-1), valid, c.outlier_factor_color)
    opacity, confidence = maps.alpha.clamp(min=0.0) ** c.alpha_power, torch.ones_like(maps.color)
    if c.uncertainty and maps.variance is not None:
        confidence = uncertainty_weights(maps.variance, in_color, c.tau, c.weight_max)
    on_color = per_value(c.weight_color, in_color, 3, c.average) * (opacity * in_color)[..., None] * confidence
    on_depth = per_value(1.0 - c.weight_color, in_depth, 1, c.average) * (opacity * in_depth)
    g_color = on_color * color_error.sign()
    rows, columns = depth_error.shape
    view.g_sums.zero_()
    view.g_sums[:3, :rows, :columns] = (gain * g_color).movedim(-1, 0)
    view.g_sums[3, :rows, :columns] = on_depth * depth_error.sign()
    loss = (on_color * color_error.abs()).sum() + (on_depth * depth_error.abs()).sum()
    g_exposure = torch.stack([(g_color * gain * maps.color).sum(), g_color.sum()])
    return float(loss), g_exposure


def tracking_params(config: TrackingConfig, alpha_above: float) -> list[float]:
    """Return the settings as `TrackOptions` of the kernels (native/track.h)."""
    c = config
    return [
        alpha_above, c.alpha_power, c.outlier_factor, c.outlier_factor_color, c.weight_color, c.tau, c.weight_max,
    ]  # fmt: skip


ALIGN_ALPHA = 0.95
"""Minimum alpha of the map for alignment; above it, C/A and D/A are those of the surface."""


def reference_maps(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Make a reference from a view's last forward pass. Weights: w̃ averaged over the channels; for depth the same
    formula with U, if the view has a moment. The maps are tensors on the device of the view's planes.

    Where the map is thin, V has no meaning and the weight is 1; so is the depth weight without U. Without variance
    there is no w̃, and gray has no weight.
    """
    maps = PoseMaps.of(view)
    opaque, divisor = maps.alpha > ALIGN_ALPHA, maps.alpha.clamp(min=0.5)
    gray, surface = luma(maps.color.movedim(-1, 0)) / divisor, torch.where(opaque, maps.depth / divisor, 0.0)
    weights: list[Tensor | None] = [None, None]
    for k, (variance, known) in enumerate(((maps.variance, opaque), (moment, opaque & (view.moment > 0)))):
        if config.uncertainty and variance is not None:
            w = uncertainty_weights(variance.reshape(*opaque.shape, -1), known, config.tau, config.weight_max).mean(-1)
            weights[k] = torch.where(known, w, 1.0)
    return ReferenceMaps(gray, surface, (weights[0], weights[1]))


def reference_arrays(view: View, config: TrackingConfig, moment: Tensor | None) -> ReferenceMaps:
    """Return the same maps as arrays, for a view whose planes are in host memory."""
    gray, surface, weights = reference_maps(view, config, moment)
    on_gray, on_depth = (None if weight is None else weight.numpy() for weight in weights)
    return ReferenceMaps(gray.numpy(), surface.numpy(), (on_gray, on_depth))
