"""Full colour covariance of a splat: a 3×3 matrix from its variances and three correlation parameters.

Σ = D R D, D = diag(exp(s/2)) from the field's `log_variances`, R = A Aᵀ a matrix of correlations. The rows of A, lower
triangular, have length 1:

    (1, 0, 0)    (t₁, √(1−t₁²), 0)    (t₂, t₃ √(1−t₂²), √(1−t₂²) √(1−t₃²))        t = 0.999 tanh(a)

a [3] are the field's `correlations`. L = D A is the Cholesky factor of Σ, and Σ is positive definite for every a. t₁
and t₂ are the correlations red–green and red–blue; t₃ is the correlation green–blue for known red. a = 0 means no
correlation: the paper's diagonal. For every a, the variances of the channels stay exp(s) (VarSplat §1). Code that reads
only the variances, such as V for tracking and loops, does not depend on a. a has no unit.
"""

import torch
from torch import Tensor

MOST_CORRELATED = 0.999
"""The largest absolute correlation: Σ stays invertible in float32."""


def correlations_of(parameters: Tensor) -> Tensor:
    """Convert a splat's three numbers a [N, 3] to the correlations red–green, red–blue, green–blue [N, 3] in (−1,
    1)."""
    t = MOST_CORRELATED * torch.tanh(parameters)
    first, second, third = t.unbind(-1)
    left = ((1.0 - first * first) * (1.0 - second * second)).sqrt()  # of green and blue for known red
    return torch.stack([first, second, first * second + third * left], -1)


def covariances_of(variances: Tensor, parameters: Tensor) -> Tensor:
    """Return Σ as (rr, gg, bb, rg, rb, gb) [N, 6] from variances exp(s) [N, 3] and a [N, 3]."""
    r, g, b = variances.sqrt().unbind(-1)
    beside = torch.stack([r * g, r * b, g * b], -1) * correlations_of(parameters)
    return torch.cat([variances, beside], -1)


def outer(x: Tensor) -> Tensor:
    """Return x xᵀ of x [..., 3] as (rr, gg, bb, rg, rb, gb) [..., 6], each of them contiguous in memory."""
    r, g, b = x.unbind(-1)
    return torch.stack([r * r, g * g, b * b, r * g, r * b, g * b]).movedim(0, -1)
