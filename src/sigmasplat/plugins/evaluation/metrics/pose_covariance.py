"""Score the covariances of poses or motions against their true errors: NEES, and coverage of the 90 % ellipsoid."""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from sigmasplat.data import se3
from sigmasplat.types import Matrix

LEVEL = 0.9
"""The coverage that is measured."""


@dataclass(frozen=True)
class CovarianceScore:
    """How honest covariances are, over `count` errors.

    NEES is eᵀ Σ⁻¹ e. If Σ is right, its mean is the number of components, 6 or 3, and `coverage_90` is 0.9: the share
    of errors inside the ellipsoid that should hold 90 %. `position_`: of the position alone. position_k: the median
    NEES of the position divided by its expected value 2.37, as in `smfeval`: the variances are k times too small.
    """

    count: int
    nees_mean: float
    nees_median: float
    coverage_90: float
    position_nees_median: float
    position_k: float
    position_coverage_90: float


def score_covariances(T_estimate: Matrix, T_true: Matrix, covariance: Matrix) -> CovarianceScore | None:
    """Score estimated poses or motions [N, 4, 4] against the true ones, given covariances [N, 6, 6] of the left twists
    of the estimates (m, rad); None without poses."""
    if not len(T_estimate):
        return None
    twists = se3.log_stack(T_true @ se3.inverse(T_estimate))
    J = se3.displacement(T_estimate)[:, :3]
    shifts = T_true[:, :3, 3] - T_estimate[:, :3, 3]
    full, position = nees(twists, covariance), nees(shifts, J @ covariance @ np.swapaxes(J, 1, 2))
    median = float(np.median(position))
    return CovarianceScore(
        len(full),
        float(full.mean()),
        float(np.median(full)),
        float((full <= chi2_quantile(LEVEL, 6)).mean()),
        median,
        median / chi2_quantile(0.5, 3),
        float((position <= chi2_quantile(LEVEL, 3)).mean()),
    )


def nees(errors: Matrix, covariance: Matrix) -> Matrix:
    """Return eᵀ Σ⁻¹ e [N] of errors [N, D] with covariances [N, D, D]."""
    return np.asarray((errors * np.linalg.solve(covariance, errors[:, :, None])[..., 0]).sum(1))


def chi2_quantile(share: float, freedom: int) -> float:
    """Return the value that a χ² variable with `freedom` degrees of freedom stays below with probability `share`."""
    return 2.0 * float(gammaincinv(freedom / 2.0, share))
