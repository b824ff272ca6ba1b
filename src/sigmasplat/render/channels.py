"""Define the channels that are summed over splats per pixel, and compute variances from the sums."""

import torch
from torch import Tensor


def features_of(colors: Tensor, z: Tensor, variances: Tensor) -> Tensor:
    """Stack the channels of each splat: (r, g, b, z, σ² + c² ×3), [N, 7]."""
    return torch.cat([colors, z[:, None], variances + colors**2], 1)


def variance_of(sums: Tensor) -> Tensor:
    """Apply the law of total variance to features [H, W, 7]: V = E[σ² + c²] − E[c]² [H, W, 3] (VarSplat §1)."""
    return sums[..., 4:7] - sums[..., 0:3] ** 2
