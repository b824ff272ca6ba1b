"""Compute weights and masks for tracking from rendered variance and depth error. No function here has a gradient."""

import torch
from torch import Tensor


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
