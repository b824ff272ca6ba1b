"""Estimate by which factors assumed variances are wrong, from residuals that should follow them.

This is the estimation of variance components (Förstner 1979, Helmert), by maximum likelihood instead of moments. Few
residuals hardly determine a factor, so each factor has a prior worth one observation (unit information, Kass &
Wasserman 1995): the inverse gamma density that one residual of exactly the assumed size leaves.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from sigmasplat.types import Matrix


def variance_factors(residuals: Matrix, fixed: Matrix, parts: Sequence[Matrix]) -> list[float]:
    """Return the most probable factor of each part of a covariance.

    residuals [N]: normal, with mean 0 and the covariance fixed + Σ factor · part, all [N, N]. Without information about
    a part its factor is 1.
    """

    def cost(logs: Matrix) -> float:
        factors = np.exp(logs)
        covariance = fixed + sum(factor * part for factor, part in zip(factors, parts, strict=True))
        try:
            root = cho_factor(covariance, lower=True)
        except np.linalg.LinAlgError:
            return float("inf")
        log_root = np.log(np.diag(root[0])).sum()
        return float(log_root + 0.5 * residuals @ cho_solve(root, residuals) + 0.5 * (logs + 1.0 / factors).sum())

    found = minimize(cost, np.zeros(len(parts)), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6})
    return [float(factor) for factor in np.exp(found.x)]
