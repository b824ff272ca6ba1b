"""The graph of keyframes: each is aligned to several earlier ones that see the same, and all poses are solved together.

Nodes are keyframes. Edges are relative poses with covariance: the hop from the keyframe before, closed loops, and
direct alignments to earlier keyframes (Kerl et al., IROS 2013). The redundancy also measures how good the edges are:
the variance of each kind of edge is multiplied by a factor that makes its residuals as large as stated (Förstner 1979).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from sigmasplat.data import se3
from sigmasplat.data.readout import UNKNOWN_TIMES, Readout, SensorTimes
from sigmasplat.data.relative_pose import Alignments, Kind, RelativePose
from sigmasplat.data.submap import Picture
from sigmasplat.fit.compare import best_alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import picture_images
from sigmasplat.graph.pose_graph import ROUGHLY, PoseGraph, factorised, minimise, most_chi2
from sigmasplat.graph.sensor_fit import MEASURED, NEIGHBOURS, Pair, measured
from sigmasplat.render.view import View
from sigmasplat.tracking.drift import UNKNOWN
from sigmasplat.tracking.pose_validation import confirmed
from sigmasplat.types import Matrix, ShouldStop, Task, never

NEAR = 0.5
"""Views are near if between them the image moves by at most this share of its width: then half of it is in both."""
APART = NEIGHBOURS + 1
"""Other keyframes that a keyframe is aligned to are this many keyframes apart: neighbours share most errors."""
NEAREST = 3
"""The nearest views are taken whatever their distance in time; one of them is the keyframe before."""
MEDIAN_CHI2 = float(chdtri(6, 0.5))
ROUNDS, STEPS, STILL = 10, 5, 0.01
"""Most rounds of weighting and factors, and steps in each; the last round changes no factor by this share."""
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


def edge_between(
    a: int, b: int, reference: Pyramid, live: Pyramid, T_b_a: Matrix, near: bool = False
) -> RelativePose | None:
    """Align keyframe b to keyframe a from a guess T_b_a [4, 4]; None if the images do not confirm the result. near: as
    of `best_alignment`."""
    motion, seen = best_alignment(reference, live, T_b_a, near=near)
    if motion.degenerate or not confirmed(seen) or not np.isfinite(motion.covariance).all():
        return None
    information = np.asarray(np.linalg.inv(motion.covariance + np.diag(motion.bias**2)))
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
        T, _ = minimise(graph, T, weights, STEPS, ROUGHLY)
        chi2, before = graph.chi2(T) * factor, factors.copy()
        for (kind, rows), free in zip(of_kind.items(), redundancies(graph, T, weights, of_kind.values()), strict=True):
            redundant = float(np.clip(free / 6.0, 1e-3 * rows.sum(), rows.sum()))  # in numbers of edges
            measured = float(np.median(chi2[rows])) / MEDIAN_CHI2 * float(rows.sum()) / redundant
            factors[kind] = (redundant * measured + 1.0) / (redundant + 1.0)
        if all(abs(factors[kind] - before[kind]) < STILL * before[kind] for kind in kinds):
            break
    solved = se3.orthonormalise(T_world_keyframe[0] @ T)
    solved[:fixed] = T_world_keyframe[:fixed]
    return KeyframeSolution(solved, factors, graph.information * (1.0 + graph.chi2(T) / scale)[:, None, None] ** -0.5)


def redundancies(graph: PoseGraph, T: Matrix, weights: Matrix, groups: Iterable[Matrix]) -> list[float]:
    """Return how many degrees of freedom the residuals of each group of edges [E] have in a solution: the trace of
    I − J H⁻¹ Jᵀ w Ω over the group."""
    blocks, _ = graph.blocks(T, weights)
    signs = np.eye(graph.size)
    if graph.size > PROBES:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (graph.size, PROBES)) / np.sqrt(PROBES)
    solved = factorised(graph.assembled(blocks)).solve(signs)
    return [
        6.0 * float(group.sum()) - float((solved * (graph.assembled(blocks * group[:, None, None]) @ signs)).sum())
        for group in groups
    ]


# ---- while it grows: a window of the graph that the end of a run solves as a whole ----

WINDOW = 10
"""So many of the newest keyframes move. Older ones move when a loop is closed, and at the end of the run. CG-SLAM
adjusts a window of keyframes together with the map; here the relative poses stand for the map."""
CACHE_BYTES = 1 << 28
"""Images of keyframes that stay in memory."""


@dataclass(eq=False)
class GrowingGraph:
    """Keeps the alignments of all keyframes; their nodes are rows of `Atlas.T_world_keyframes`. most: per keyframe;
    calibrates: whether the times of the sensor are measured; times: as the alignments show them; measured: number of
    alignments when they were last measured."""

    most: int
    calibrates: bool = False
    edges: Alignments = field(default_factory=Alignments)
    times: SensorTimes = UNKNOWN_TIMES
    measured: int = 0

    def aligning(
        self, T_world_keyframe: Matrix, rows: NDArray[np.int64], image: Callable[[int], Pyramid],
        should_stop: ShouldStop = never,
    ) -> Task[None]:  # fmt: skip
        """Align the newest keyframe of T_world_keyframe [K, 4, 4] to earlier ones, one per slice, until `should_stop`.

        rows [n]: which keyframes may be used, in order; the newest is the last one.
        """
        b = int(rows[-1])
        live = image(b)
        for i in partners(T_world_keyframe[rows], float(live.readings[0]), live.cameras[0].width_rad, self.most):
            a = int(rows[i])
            guess = se3.inverse(T_world_keyframe[b]) @ T_world_keyframe[a]
            edge = edge_between(a, b, image(a), live, guess)
            if edge is not None:
                self.edges.append(edge)
            if should_stop():
                return
            yield

    def pairs(self, image: Callable[[int], Pyramid], reading: Callable[[int], Readout], most: int) -> list[Pair]:
        """Return the images of at most so many alignments, at half the size; image, reading: of a row."""
        chosen = self.edges[:: -(-len(self.edges) // most) or 1]
        halves = ((image(e.b).half(), image(e.a).half(), reading(e.b), reading(e.a), e.T_a_b, e.a) for e in chosen)
        return [Pair(*half) for half in halves]

    @property
    def is_due(self) -> bool:
        """Return whether the times of the sensor are to be measured: again each time that there are twice as many
        alignments, until the images show them."""
        enough = len(self.edges) >= max(MEASURED, 2 * self.measured)
        return self.calibrates and self.times.std_s is None and enough

    def measuring(self, image: Callable[[int], Pyramid], reading: Callable[[int], Readout]) -> Task[None]:
        """Measure when the sensor reads, in slices of one pair, and then align all again; image, reading: of a row."""
        self.measured = len(self.edges)
        self.times = yield from measured(self.pairs(image, reading, MEASURED))
        if self.times.std_s is None:
            return
        again = Alignments()
        again.rows.folder = self.edges.rows.folder
        for edge in self.edges:
            found = edge_between(edge.b, edge.a, image(edge.b), image(edge.a), edge.T_a_b, near=True)
            if found is not None:
                again.append(found)
            yield
        self.edges = again

    def solved(self, T_world_keyframe: Matrix, hops: Sequence[RelativePose], first: int) -> Matrix:
        """Return the poses [n, 4, 4] of the keyframes from row `first` on that agree best with their edges to each
        other and to earlier keyframes, which stay; those of T_world_keyframe [K, 4, 4] are the first guess. hops: one
        to each of them."""
        T = T_world_keyframe
        rows_of_hops = zip(range(first, len(T)), hops, strict=True)
        edges = [hop_between(row, row - 1, hop, se3.inverse(T[row]) @ T[row - 1]) for row, hop in rows_of_hops]
        edges += self.edges.touching(first)
        rows = np.unique([*(edge.a for edge in edges), *(edge.b for edge in edges)])
        node = {row: i for i, row in enumerate(rows.tolist())}
        local = [RelativePose(node[e.a], node[e.b], e.T_a_b, e.information, e.kind) for e in edges]
        fixed = int((rows < first).sum())
        return solve(T[rows], local, fixed).T_world_keyframe[fixed:]


@dataclass(eq=False)
class KeyframeImages:
    """Images of keyframes for alignment. They are made from what the map keeps of them, so that a resumed run aligns
    the same; those that were used last stay in memory.

    kept: by row of `Atlas.T_world_keyframes`: number of readings, and images.
    """

    kept: dict[int, tuple[int, Pyramid]] = field(default_factory=dict)

    def of(self, row: int, view: View, picture: Callable[[], Picture], readings: int | None = None) -> Pyramid:
        """Return the images of a keyframe; readings: of its depth, if the map may still mask some; None: no more."""
        found = self.kept.pop(row, None)
        if found is None or readings not in (None, found[0]):
            target, pyramid = picture_images(view, picture(), view.camera)
            found = target.valid_pixels, pyramid
        self.kept[row] = found
        if len(self.kept) > max(2, CACHE_BYTES // (16 * view.camera.width * view.camera.height)):
            del self.kept[next(iter(self.kept))]
        return found[1]

    def settle(self, row: int, readings: int) -> None:
        """Forget the images of a keyframe whose depth was masked since, which is final from now on."""
        if row in self.kept and self.kept[row][0] != readings:
            del self.kept[row]
