"""Define the channels that are summed over splats per pixel, and compute variances from the sums."""

import torch
from torch import Tensor

from sigmasplat.data.color_covariance import covariances_of, outer

COVARIANCE_PLANES = 10
"""Channels of `covariance_features`."""


def features_of(colors: Tensor, z: Tensor, variances: Tensor) -> Tensor:
    """Stack the channels of each splat: (r, g, b, z, σ² + c² ×3), [N, 7]."""
    return torch.cat([colors, z[:, None], variances + colors**2], 1)


def variance_of(sums: Tensor) -> Tensor:
    """Apply the law of total variance to features [H, W, 7]: V = E[σ² + c²] − E[c]² [H, W, 3] (VarSplat §1)."""
    return sums[..., 4:7] - sums[..., 0:3] ** 2


def covariance_features(colors: Tensor, z: Tensor, variances: Tensor, correlations: Tensor) -> Tensor:
    """Stack the channels of splats with correlated colours: (r, g, b, z, Σ + c cᵀ ×6), [N, 10], as `features_of`."""
    return torch.cat([colors, z[:, None], covariances_of(variances, correlations) + outer(colors)], 1)


def covariance_of(color: Tensor, second: Tensor) -> Tensor:
    """Apply the law of total covariance: V = E[Σ + c cᵀ] − E[c] E[c]ᵀ [H, W, 6] of E[c] [H, W, 3] and E[Σ + c cᵀ]."""
    return second - outer(color)
