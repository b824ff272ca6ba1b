"""Solve the normal equations of a pose graph: of a small graph by factorisation, of a large one iteratively."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from sigmasplat.types import Matrix

ENOUGH = 1e-8
"""Residual of an iterative solution relative to the right-hand side."""
MOST_BY_BLOCKS, MOST_BY_FACTORS = 200, 30
"""Maximum number of iterations with each preconditioner."""


def factorised(H: csc_array) -> SuperLU:
    """Factorise a symmetric positive definite matrix."""
    return splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@dataclass(eq=False)
class Solver:
    """Solves H δ = g for matrices H of one graph, which change little from one step to the next.

    A large H is solved by conjugate gradients. The first preconditioner is the inverse of its diagonal blocks. It is
    enough if many loops connect all parts of the graph: then a factorisation is nearly dense and takes minutes. It is
    not enough for long chains. Their factorisation is cheap: it is the preconditioner from then on, and is made again
    when H has changed too much.
    """

    large: bool
    factors: SuperLU | None = None

    def solve(self, H: csc_array, g: Matrix) -> Matrix:
        """Return δ."""
        if self.large:
            inverse, most = (self.factors or _Blocks(H)).solve, MOST_BY_FACTORS if self.factors else MOST_BY_BLOCKS
            nearly = LinearOperator(H.shape, matvec=inverse, dtype=g.dtype)
            delta, failed = cg(H, g, rtol=ENOUGH, atol=0.0, maxiter=most, M=nearly)
            if not failed:
                return np.asarray(delta)
        self.factors = factorised(H)
        return np.asarray(self.factors.solve(g))


class _Blocks:
    """The inverse of the diagonal 6×6 blocks of a matrix."""

    def __init__(self, H: csc_array) -> None:
        blocks = H.tobsr((6, 6))
        on_diagonal = blocks.indices == np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
        self.inverse = np.linalg.inv(blocks.data[on_diagonal])

    def solve(self, g: Matrix) -> Matrix:
        """Return the product with g [6 N]."""
        return np.asarray(np.einsum("nij,nj->ni", self.inverse, g.reshape(-1, 6))).ravel()
