"""The graph of keyframes: each is aligned to several earlier ones that see the same, and all poses are solved together.

Nodes are keyframes. Edges are relative poses with covariance: the hop from the keyframe before, closed loops, and
direct alignments to earlier keyframes (Kerl et al., IROS 2013). The redundancy also measures how good the edges are:
the variance of each kind of edge is multiplied by a factor that its residuals ask for (Förstner 1979).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from sigmasplat.data import se3
from sigmasplat.data.relative_pose import Kind, RelativePose, SolvedGraph
from sigmasplat.fit.compare import best_alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.normal_equations import factorised
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.graph.pose_graph import PoseGraph, minimise, most_chi2
from sigmasplat.tracking.drift import UNKNOWN
from sigmasplat.tracking.pose_validation import confirmed
from sigmasplat.types import Matrix

NEAR = 0.5
"""Views are near if between them the image moves by at most this share of its width: then half of it is in both."""
APART = 4
"""Other keyframes that a keyframe is aligned to are this many keyframes apart: neighbours share most errors."""
NEAREST = 3
"""The nearest views are taken whatever their distance in time; one of them is the keyframe before."""
MEDIAN_CHI2 = float(chi2_distribution.median(6))
ROUNDS, STEPS = 10, 5
"""Rounds of weighting and factors, and steps of the solution in each."""
PROBES = 600
"""Redundancies of larger systems than this are estimated with this many random signs (Hutchinson 1990)."""


@dataclass(frozen=True, eq=False)
class KeyframeSolution:
    """T_world_keyframe [K, 4, 4], the factor on the variance of each kind of edge, and the information [E, 6, 6] of the
    edges with factor and weight; empty if the edges do not determine more than a chain."""

    T_world_keyframe: Matrix
    factors: dict[Kind, float]
    information: Matrix


# ---- edges ----


def edge_between(a: int, b: int, reference: Pyramid, live: Pyramid, T_b_a: Matrix) -> RelativePose | None:
    """Align keyframe b to keyframe a from a guess T_b_a [4, 4]; None if the images do not confirm the result."""
    motion, seen = best_alignment(reference, live, T_b_a)
    covariance = motion.covariance + np.diag(motion.bias**2)
    if motion.degenerate or not confirmed(seen) or not np.isfinite(covariance).all():
        return None
    information = np.asarray(np.linalg.inv(covariance))
    return RelativePose(b, a, motion.T_live_reference, information, "alignment", bias=motion.bias)


def hop_between(a: int, b: int, hop: RelativePose, T_a_b: Matrix) -> RelativePose:
    """Return a hop as an edge between nodes, as tracking found it, or T_a_b [4, 4] with no certainty where tracking
    could not tell its error."""
    known = hop.total_covariance
    if known is None:
        return RelativePose(a, b, T_a_b, np.asarray(np.linalg.inv(UNKNOWN)), "hop")
    return RelativePose(a, b, hop.T_a_b, np.asarray(np.linalg.inv(known)), "hop", bias=hop.bias)


def partners(T_world_keyframe: Matrix, depth_m: float, width_rad: float, most: int) -> list[int]:
    """Return at most `most` earlier keyframes that the newest of T_world_keyframe [K, 4, 4] is aligned to: the one
    before and the nearest views, then near views that are spread over time.

    depth_m: mean depth of the newest; width_rad: angle of view.
    """
    newest = len(T_world_keyframe) - 1
    away_m = np.linalg.norm(T_world_keyframe[:newest, :3, 3] - T_world_keyframe[newest, :3, 3], axis=1)
    moved = away_m / (depth_m * width_rad)
    close = np.flatnonzero(moved < NEAR)
    turned = se3.log_stack(se3.inverse(T_world_keyframe[newest]) @ T_world_keyframe[close])[:, 3:]
    moved[close] += np.linalg.norm(turned, axis=1) / width_rad
    near = [k for k in np.argsort(moved, kind="stable").tolist() if moved[k] < NEAR and k != newest - 1]
    chosen = [newest - 1, *near[: NEAREST - 1]]
    for k in near[NEAREST - 1 :]:
        if len(chosen) < most and all(abs(k - other) >= APART for other in (*chosen, newest)):
            chosen.append(k)
    return chosen[:most]


def alignments(
    T_world_keyframe: Matrix, image: Callable[[int], Pyramid], most: int, known: Sequence[RelativePose] = ()
) -> list[RelativePose]:
    """Align each keyframe to at most `most` earlier ones, from poses [K, 4, 4]; return what the images confirm.

    known: alignments that need not be made again, nor those to keyframes that are near in time to theirs.
    """
    found, ends = list[RelativePose | None](), np.array([(e.a, e.b) for e in known], np.int64).reshape(-1, 2)
    for b in range(1, len(T_world_keyframe)):
        live, T_b_world = image(b), se3.inverse(T_world_keyframe[b])
        aligned_to = ends[ends[:, 0] == b, 1]
        for a in partners(T_world_keyframe[: b + 1], float(live.readings[0]), live.cameras[0].width_rad, most):
            if not (np.abs(aligned_to - a) < APART).any():
                found.append(edge_between(a, b, image(a), live, T_b_world @ T_world_keyframe[a]))
    return [edge for edge in found if edge is not None]


# ---- solution ----


def solve(T_world_keyframe: Matrix, edges: Sequence[RelativePose], fixed: int = 1) -> KeyframeSolution:
    """Find the poses [K, 4, 4] that agree best with all edges; the first `fixed` ones stay.

    The loss is pseudo-Huber at the scale of the χ² test of loops. It is convex: drift that far edges contradict cannot
    pass for outliers, as it does with a loss that lets them go. The factor of a kind makes the median χ² of its edges
    that of χ² with as many degrees of freedom as the edges are redundant; a prior worth one edge keeps the factor of a
    kind without redundancy at 1. With a chain alone the poses are returned unchanged.
    """
    kinds = sorted({edge.kind for edge in edges})
    factors: dict[Kind, float] = dict.fromkeys(kinds, 1.0)
    if len(edges) <= len(T_world_keyframe) - fixed or fixed == len(T_world_keyframe):
        return KeyframeSolution(T_world_keyframe, factors, np.empty((0, 6, 6)))
    of_kind = {kind: np.array([edge.kind == kind for edge in edges]) for kind in kinds}
    graph = PoseGraph(len(T_world_keyframe), edges, fixed)
    claimed, scale = graph.information, most_chi2()
    T = se3.inverse(T_world_keyframe[:1]) @ T_world_keyframe
    for _ in range(ROUNDS):
        factor = np.sum([factors[kind] * rows for kind, rows in of_kind.items()], axis=0)
        graph.information = claimed / factor[:, None, None]
        weights = (1.0 + graph.chi2(T) / scale) ** -0.5
        T, _ = minimise(graph, T, weights, STEPS)
        chi2 = graph.chi2(T) * factor
        for (kind, rows), free in zip(of_kind.items(), redundancies(graph, T, weights, of_kind.values()), strict=True):
            redundant = float(np.clip(free / 6.0, 1e-3 * rows.sum(), rows.sum()))  # in numbers of edges
            measured = float(np.median(chi2[rows])) / MEDIAN_CHI2 * float(rows.sum()) / redundant
            factors[kind] = (redundant * measured + 1.0) / (redundant + 1.0)
    solved = se3.orthonormalise(T_world_keyframe[0] @ T)
    solved[:fixed] = T_world_keyframe[:fixed]
    return KeyframeSolution(solved, factors, graph.information * (1.0 + graph.chi2(T) / scale)[:, None, None] ** -0.5)


def redundancies(graph: PoseGraph, T: Matrix, weights: Matrix, groups: Iterable[Matrix]) -> list[float]:
    """Return how many degrees of freedom the residuals of each group of edges [E] have in a solution: the trace of
    I − J H⁻¹ Jᵀ w Ω over the group."""
    H, _ = graph.normal_equations(T, weights)
    size = H.shape[0]
    signs = np.eye(size)
    if size > PROBES:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (size, PROBES)) / np.sqrt(PROBES)
    solved = factorised(H).solve(signs)
    return [
        6.0 * float(group.sum()) - float((solved * (graph.normal_equations(T, weights * group)[0] @ signs)).sum())
        for group in groups
    ]


# ---- the graph of a run ----


@dataclass(frozen=True, eq=False)
class KeyframeNodes:
    """The keyframes of one component as nodes. A keyframe that two submaps share is one node.

    rows [N]: the row of each node in `path`, the later one of two copies, in the order of the frames; frames [N]: their
    numbers; node [K]: the node of each row, −1 in other components; fixed: how many nodes, the first ones, do not move.
    """

    path: PathCovariance
    rows: NDArray[np.int64]
    frames: NDArray[np.int64]
    node: NDArray[np.int64]
    fixed: int

    @staticmethod
    def of(path: PathCovariance, frames: Mapping[int, Sequence[int]]) -> "KeyframeNodes":
        """Return the nodes of the submaps `frames`, which gives the frame numbers of their keyframes. Those of earlier
        sessions, below 0, do not move."""
        submaps = path.keyframe_submap
        wanted = np.flatnonzero(np.isin(submaps, list(frames)))
        numbers = np.concatenate([np.array(frames[s], np.int64) for s in sorted(frames)])
        known, copies = np.unique(numbers, return_inverse=True)
        rows, node = np.zeros(len(known), np.int64), np.full(len(submaps), -1)
        rows[copies], node[wanted] = wanted, copies
        return KeyframeNodes(path, rows, known, node, max(1, int((known < 0).sum())))

    @property
    def T_world_keyframe(self) -> Matrix:
        """Return the poses of the nodes [N, 4, 4]."""
        path = self.path
        return np.asarray(path.anchors[path.keyframe_submap[self.rows]] @ path.T_submap_keyframe[self.rows])

    def edges(self) -> list[RelativePose]:
        """Return what the run knows between the nodes: hops, closed loops, and links between submaps that do not share
        a keyframe."""
        path, submap, T = self.path, self.path.keyframe_submap, self.path.T_submap_keyframe
        first = np.searchsorted(submap, np.arange(len(path.anchors)))
        found = []
        for row in np.flatnonzero(self.node >= 0)[1:].tolist():
            if submap[row] == submap[row - 1]:
                a, b = self.node[[row, row - 1]].tolist()
                found.append(hop_between(a, b, path.hops.hop(row), se3.inverse(T[row]) @ T[row - 1]))
        for edge in path.edges:
            a, b = (int(first[s]) + k for s, k in zip((edge.a, edge.b), edge.keyframes, strict=True))
            if self.node[a] < 0 or self.node[a] == self.node[b] or self._share(edge):
                continue
            T_a_b, A = se3.inverse(T[a]) @ edge.T_a_b @ T[b], se3.adjoint(se3.inverse(T[a]))
            information = np.asarray(np.linalg.inv(A @ edge.measured @ A.T))
            found.append(RelativePose(self.node[a], self.node[b], T_a_b, information, edge.kind))
        return found

    def numbered(self, alignments: Iterable[RelativePose]) -> list[RelativePose]:
        """Return alignments between rows as edges between their nodes."""
        ends = ((int(self.node[edge.a]), int(self.node[edge.b]), edge) for edge in alignments)
        return [replace(edge, a=a, b=b) for a, b, edge in ends if min(a, b) >= 0 and a != b]

    def _share(self, edge: RelativePose) -> bool:
        """Return whether the two submaps of an edge share a keyframe, whose node connects them exactly."""
        of_a, of_b = (self.node[self.path.keyframe_submap == s] for s in (edge.a, edge.b))
        return edge.kind == "odometry" and bool(np.isin(of_b, of_a).any())

    def spread(self, T_world_node: Matrix) -> Matrix:
        """Return the poses of all rows [K, 4, 4], T_world_keyframe, given those of the nodes; other components stay."""
        path = self.path
        poses = path.anchors[path.keyframe_submap] @ path.T_submap_keyframe
        known = self.node >= 0
        poses[known] = T_world_node[self.node[known]]
        return np.asarray(poses)

    def solved(self, solution: KeyframeSolution, edges: Sequence[RelativePose], shared: Matrix) -> SolvedGraph | None:
        """Return the graph as the errors of the path need it; None if it has not moved the chain. shared: errors as of
        `SolvedGraph`."""
        if not len(solution.information):
            return None
        ends = np.array([(edge.a, edge.b) for edge in edges], np.int64)
        T_a_b = np.array([edge.T_a_b for edge in edges])
        return SolvedGraph(self.node, solution.T_world_keyframe, self.fixed, ends, T_a_b, solution.information, shared)
