"""Solve a robust pose graph: Levenberg–Marquardt on SE(3) that rejects false loops.

Odometry edges are trusted. Loop edges are judged while the graph is solved, by graduated non-convexity with the
Geman–McClure loss (Yang et al., RA-L 2020). At first every loop has nearly full weight; at the end only loops that
agree with the rest of the graph have. Then accepted loops get weight 1 and the others weight 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu
from scipy.special import gammaincinv

from sigmasplat.data import se3
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.errors import SigmaSplatError
from sigmasplat.types import Matrix

PRUNE_WEIGHT = 0.25
"""A loop with a lower weight is rejected (VarSplat §6): at μ = 1 this is the χ² test, r² > c²."""
GRADUATION = 1.4
"""Factor from one μ to the next (Yang et al. 2020, remark 5)."""
STEPS_PER_MU = 10
"""Enough steps to converge: with two, one loop that was wrong by half a turn made thirteen true ones be rejected."""
LARGE = 100
"""A graph with more free nodes than this is solved iteratively."""
SETTLED = 1e-10
"""A solution is found when a step lowers the cost by less than this share."""
ROUGHLY = 1e-3
"""The same before the last μ in a large graph: these solutions only lead to the next one."""


@dataclass(frozen=True)
class LoopVerdict:
    """Whether a loop was accepted; its Geman–McClure weight in [0, 1] at the decision; the χ² (6 degrees of
    freedom) of its difference to the solution."""

    weight: float
    chi2: float
    accepted: bool


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """T_world_node [N, 4, 4]; one verdict per loop edge in the order of the edges; number of steps of
    Levenberg–Marquardt."""

    T_world_node: Matrix
    verdicts: tuple[LoopVerdict, ...]
    iterations: int


def optimise(
    T_world_node: Matrix, edges: Sequence[RelativePose], confidence: float = 0.99, max_iterations: int = 100,
    fixed: int = 1, rejected: Sequence[bool] = (),
) -> PoseGraphSolution:  # fmt: skip
    """Find the poses [N, 4, 4] that agree best with the edges; the first `fixed` nodes, at least node 0, stay.

    A loop is rejected if its χ² exceeds the `confidence` quantile of 6 degrees of freedom; with confidence = 1 every
    loop is accepted (plain least squares). Without loops the poses are returned unchanged. After the verdicts, up to
    `max_iterations` more steps are taken.

    rejected [E]: loops that an earlier solution has rejected; by default none. They are judged again, but do not
    prolong the solution: it starts as if they were not there.

    Each node must be connected to a fixed one by trusted edges: if its loops are rejected, nothing else determines its
    pose. Raises SigmaSplatError on edges that are not rigid, or whose information is not symmetric positive definite.
    """
    poses = np.array(T_world_node, np.float64)
    _refuse_bad_input(edges)
    if not any(edge.loop for edge in edges):
        return PoseGraphSolution(poses, (), 0)
    graph = PoseGraph(len(poses), edges, fixed)
    # Relative to node 0, so that rounding and the steps do not depend on the origin of the world.
    start = se3.inverse(poses[:1]) @ poses
    chi2_limit = most_chi2(confidence)
    judged_first = graph.loop & ~np.array(rejected, bool) if len(rejected) else graph.loop
    T, weights, graduating = _graduate(graph, start, chi2_limit, judged_first)
    valid = np.where(graph.loop, weights >= PRUNE_WEIGHT, True)
    T, finishing = minimise(graph, T, valid.astype(np.float64), max_iterations)
    chi2 = graph.chi2(T)
    verdicts = tuple(
        LoopVerdict(float(weights[i]), float(chi2[i]), bool(valid[i])) for i, edge in enumerate(edges) if edge.loop
    )
    solved = se3.orthonormalise(poses[0] @ T)
    solved[:fixed] = poses[:fixed]
    return PoseGraphSolution(solved, verdicts, graduating + finishing)


def most_chi2(confidence: float = 0.99) -> float:
    """Return the χ² of a loop, with 6 degrees of freedom, above which it is rejected."""
    return 2.0 * float(gammaincinv(3.0, confidence))


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


class PoseGraph:
    """The edges as arrays, and the position of their blocks in the normal equations, of `size` rows. The first `fixed`
    nodes have none."""

    def __init__(self, nodes: int, edges: Sequence[RelativePose], fixed: int = 1) -> None:
        self.nodes, self.fixed, self.size = nodes, fixed, 6 * (nodes - fixed)
        self.is_large = nodes - fixed > LARGE
        self.solver = Solver(self.is_large)
        self.a = np.array([edge.a for edge in edges], np.intp)
        self.b = np.array([edge.b for edge in edges], np.intp)
        self.loop = np.array([edge.loop for edge in edges], bool)
        self.T_b_a = se3.inverse(np.stack([edge.T_a_b for edge in edges]).astype(np.float64))
        self.information = np.stack([edge.information for edge in edges]).astype(np.float64)
        rows = np.stack([self.a, self.b, self.a, self.b])[:, :, None, None] - fixed
        columns = np.stack([self.a, self.b, self.b, self.a])[:, :, None, None] - fixed
        blocks, six = (4, len(edges), 6, 6), np.arange(6)
        self._free = np.broadcast_to((rows >= 0) & (columns >= 0), blocks)
        self._rows = np.broadcast_to(6 * rows + six[:, None], blocks)[self._free]
        self._columns = np.broadcast_to(6 * columns + six, blocks)[self._free]

    def residuals(self, T_world_node: Matrix) -> Matrix:
        """Return the difference of the poses to each edge as a twist e [E, 6]: T_a⁻¹ T_b = exp(e) T_a_b."""
        T_a_b = se3.inverse(T_world_node[self.a]) @ T_world_node[self.b]
        return se3.log_stack(T_a_b @ self.T_b_a)

    def chi2(self, T_world_node: Matrix) -> Matrix:
        """Return eᵀΩe of every edge, [E]."""
        e = self.residuals(T_world_node)
        return np.asarray(np.einsum("ei,eij,ej->e", e, self.information, e))

    def jacobians(self, T_world_node: Matrix, e: Matrix) -> Matrix:
        """Return ∂e/∂δ_b = J⁻¹(e) Ad(T_a⁻¹), [E, 6, 6], for T_b ← exp(δ_b) T_b; ∂e/∂δ_a is its negative."""
        return se3.left_jacobian_inverse(e) @ se3.adjoint(se3.inverse(T_world_node[self.a]))

    def normal_equations(self, T_world_node: Matrix, weights: Matrix) -> tuple[csc_array, Matrix]:
        """Return H = Σ w JᵀΩJ and g = Σ w JᵀΩe of the free nodes. H is the graph's Laplacian in 6×6 blocks."""
        blocks, pull = self.blocks(T_world_node, weights)
        g = np.zeros((self.nodes, 6))
        np.add.at(g, self.b, pull)
        np.add.at(g, self.a, -pull)
        return self.assembled(blocks), g[self.fixed :].ravel()

    def blocks(self, T_world_node: Matrix, weights: Matrix) -> tuple[Matrix, Matrix]:
        """Return w JᵀΩJ [E, 6, 6] and w JᵀΩe [E, 6] of every edge."""
        e = self.residuals(T_world_node)
        J = self.jacobians(T_world_node, e)
        weighted = weights[:, None, None] * (np.swapaxes(J, 1, 2) @ self.information)
        return weighted @ J, (weighted @ e[:, :, None])[..., 0]

    def assembled(self, blocks: Matrix) -> csc_array:
        """Return H, given the blocks [E, 6, 6] of the edges."""
        values = np.stack([blocks, blocks, -blocks, -blocks])[self._free]
        return coo_array((values, (self._rows, self._columns)), shape=(self.size, self.size)).tocsc()


def _graduate(
    graph: PoseGraph, T: Matrix, chi2_limit: float, judged_first: NDArray[np.bool_]
) -> tuple[Matrix, Matrix, int]:
    """Solve for decreasing μ: return poses, weights [E] of the Geman–McClure loss with c² = chi2_limit, steps taken.

    w = (μc² / (r² + μc²))², μ from 2 max r² / c² down to 1 (Yang et al. 2020, eq. 12 and remark 5). The first r²
    is that of the loops `judged_first` [E] at the given poses. It is not that of a solution with equal weights, because
    false loops distort such a solution most.
    """
    chi2, steps = graph.chi2(T), 0
    mu = max(2.0 * float(chi2[judged_first].max(initial=0.0)) / chi2_limit, 1.0)
    enough = ROUGHLY if graph.is_large else SETTLED
    while True:
        weights = np.where(graph.loop, 1.0 / (1.0 + chi2 / (mu * chi2_limit)) ** 2, 1.0)
        T, taken = minimise(graph, T, weights, STEPS_PER_MU, SETTLED if mu == 1.0 else enough)
        chi2, steps = graph.chi2(T), steps + taken
        if mu == 1.0:
            return T, 1.0 / (1.0 + chi2 / chi2_limit) ** 2, steps
        mu = max(mu / GRADUATION, 1.0)


def minimise(
    graph: PoseGraph, T: Matrix, weights: Matrix, max_iterations: int, enough: float = SETTLED
) -> tuple[Matrix, int]:
    """Minimise Σ w eᵀΩe by Levenberg–Marquardt from poses T; return the poses and the number of steps tried.

    enough: a step that lowers the cost by less than this share is the last one. Damping is proportional to H's diagonal
    and starts very small, because the smallest eigenvalues of a chain are about N² times smaller than the diagonal.
    """
    cost, damping = float(weights @ graph.chi2(T)), 1e-9
    for step in range(1, max_iterations + 1):
        H, g = graph.normal_equations(T, weights)
        H.setdiag(H.diagonal() * (1.0 + damping))
        delta = graph.solver.solve(H, -g)
        moved = T.copy()
        moved[graph.fixed :] = se3.exp_stack(delta.reshape(-1, 6)) @ T[graph.fixed :]
        cost_moved = float(weights @ graph.chi2(moved))
        if cost_moved < cost:
            settled = cost - cost_moved < enough * cost and damping < 1e-6
            T, cost, damping = moved, cost_moved, damping / 10.0
        else:
            settled = bool(np.abs(delta).max() < 1e-9) or damping > 1e6
            damping *= 100.0
        if settled:
            return T, step
    return T, max_iterations


class Sensitivity:
    """How the errors of the edges move the nodes of a solved graph, to first order; the first `fixed` do not move.

    Each edge has an error ξ: the true motion is exp(ξ) T_a_b. The solution then has the error ε = Σ G ξ: the true pose
    of a node is exp(ε) T_world_node. The normal equations are factorised once. A node costs one sparse solution with
    six right-hand sides, and one product per edge.
    """

    def __init__(self, T_world_node: Matrix, edges: Sequence[RelativePose], fixed: int = 1) -> None:
        self.graph = graph = PoseGraph(len(T_world_node), edges, fixed)
        e = graph.residuals(T_world_node)
        H, _ = graph.normal_equations(T_world_node, np.ones(len(edges)))
        self._solver = factorised(H)
        self._pull = np.swapaxes(graph.jacobians(T_world_node, e), 1, 2) @ graph.information

    def of(self, node: int) -> Matrix:
        """Return G [E, 6, 6] of a node, one block per edge."""
        columns = np.zeros((self.graph.nodes, 6, 6))  # H⁻¹ between every node and this one
        free = node - self.graph.fixed
        if free >= 0:
            unit = np.eye(self.graph.size, 6, -6 * free)
            columns[self.graph.fixed :] = self._solver.solve(unit).reshape(-1, 6, 6)
        return np.asarray(np.swapaxes(columns[self.graph.b] - columns[self.graph.a], 1, 2) @ self._pull)


def _refuse_bad_input(edges: Sequence[RelativePose]) -> None:
    """Raise SigmaSplatError if a motion is not rigid or its information not symmetric positive definite, up to
    rounding: both would spread to all poses."""
    if not edges:
        return
    information = np.stack([edge.information for edge in edges])
    good = np.isfinite(information).all((1, 2)) & se3.are_rigid(np.stack([edge.T_a_b for edge in edges]))
    known = np.where(good[:, None, None], information, np.eye(6))
    good &= np.abs(known - np.swapaxes(known, 1, 2)).max((1, 2)) <= 1e-9 * np.abs(known).max((1, 2))
    eigenvalues = np.linalg.eigvalsh(known)
    good &= eigenvalues[:, 0] > np.finfo(np.float64).eps * eigenvalues[:, -1]
    for i in np.flatnonzero(~good).tolist():
        raise SigmaSplatError(
            f"pose graph: edge {edges[i].a} → {edges[i].b} is not a rigid motion with symmetric positive definite "
            "information"
        )
