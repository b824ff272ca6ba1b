"""Measured poses relative to each other, one by one and in columns: hops between keyframes, edges of the pose graph."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.poses import Column, Records
from sigmasplat.types import Matrix

Kind = Literal["hop", "odometry", "loop", "relocalisation", "join", "alignment"]
"""hop: from a keyframe to the one before, as tracking found it; odometry: to the next submap at a cut; loop: judged by
the pose graph, unlike the others; relocalisation: to the place where the camera was found; join: between components;
alignment: between keyframes that see the same."""


@dataclass(frozen=True, eq=False, slots=True)
class RelativePose:
    """T_a_b [4, 4] of submap or camera b in a, with an error: the true pose is exp(ξ) T_a_b, ξ = (ρ, φ), m and rad.

    a, b: numbers of submaps, −1 in a hop. information or covariance [6, 6]: of ξ, the one that was estimated; the other
    is nan, and so are both for the first keyframe of a submap. bias [6]: standard deviation of the error that is the
    same in all hops. A loop compares a keyframe of submap a with one of submap b: `keyframes`, counted in their
    submaps. drift [6, 6]: the part of its covariance that is the drift from the submaps' first keyframes to these two.
    """

    a: int
    b: int
    T_a_b: Matrix
    information: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    kind: Kind = "odometry"
    keyframes: tuple[int, int] = (0, 0)
    drift: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    covariance: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    bias: Matrix = field(default_factory=lambda: np.zeros(6))

    @staticmethod
    def hop(T_camera_before: Matrix, covariance: Matrix | None = None, bias: Matrix | None = None) -> "RelativePose":
        """Return the motion to a keyframe from the one before; covariance None: it is not known."""
        known = np.full((6, 6), np.nan) if covariance is None else covariance
        same = np.zeros(6) if bias is None else bias
        return RelativePose(-1, -1, T_camera_before, kind="hop", covariance=known, bias=same)

    @property
    def loop(self) -> bool:
        """Return whether the pose graph judges it."""
        return self.kind == "loop"

    @property
    def total_covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of a hop with its bias; None if it is not known."""
        return self.covariance + np.diag(self.bias**2) if np.isfinite(self.covariance).all() else None

    @property
    def measured(self) -> Matrix:
        """Return the covariance [6, 6] of the measurement alone, without drift."""
        return np.asarray(np.linalg.inv(self.information) - self.drift)


UNKNOWN_HOP = RelativePose.hop(np.eye(4))


@dataclass(eq=False)
class TrackedHops(Records[RelativePose]):
    """The hops to all keyframes, submap by submap. rows [K, 59]: submap, then T_camera_before, covariance and bias by
    rows."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, 1 + 16 + 36 + 6))

    def append(self, submap: int, hop: RelativePose) -> None:
        """Append the hop to the next keyframe, which is in a submap that is not before the last one."""
        self.rows.append([submap, *hop.T_a_b.ravel(), *hop.covariance.ravel(), *hop.bias])

    @property
    def T_camera_before(self) -> Matrix:
        """Return the motion of each hop [K, 4, 4]."""
        return self.rows.used[:, 1:17].reshape(-1, 4, 4).copy()

    @property
    def covariance(self) -> Matrix:
        """Return the covariance of each hop [K, 6, 6]."""
        return self.rows.used[:, 17:53].reshape(-1, 6, 6).copy()

    @property
    def bias(self) -> Matrix:
        """Return the bias of each hop [K, 6]."""
        return self.rows.used[:, 53:].copy()

    def _record(self, i: int) -> RelativePose:
        row = self.rows.used[i]
        T_camera_before, covariance = row[1:17].reshape(4, 4).copy(), row[17:53].reshape(6, 6).copy()
        return RelativePose.hop(T_camera_before, covariance, row[53:].copy())


@dataclass(eq=False)
class Alignments(Records[RelativePose]):
    """Alignments between keyframes, in the order in which they were made. rows [E, 60]: b, which is later, and a, then
    T_b_a, information and bias by rows."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, 2 + 16 + 36 + 6))

    def append(self, edge: RelativePose) -> None:
        """Append an alignment from its later keyframe, `edge.a`, to an earlier one."""
        self.rows.append([edge.a, edge.b, *edge.T_a_b.ravel(), *edge.information.ravel(), *edge.bias])

    def touching(self, first: int) -> list[RelativePose]:
        """Return the alignments of keyframes from row `first` on."""
        return self[int(np.searchsorted(self.rows.used[:, 0], first)) :]

    def _record(self, i: int) -> RelativePose:
        row = self.rows.used[i].copy()
        T_a_b, information = row[2:18].reshape(4, 4), row[18:54].reshape(6, 6)
        return RelativePose(int(row[0]), int(row[1]), T_a_b, information, "alignment", bias=row[54:])


@dataclass(frozen=True, eq=False)
class Hops:
    """The motion to each of K keyframes from the one before it in its submap, as tracking found it:
    T_camera_before [K, 4, 4], covariance [K, 6, 6], bias [K, 6]."""

    T_camera_before: Matrix
    covariance: Matrix
    bias: Matrix

    def hop(self, row: int) -> RelativePose:
        """Return one hop."""
        return RelativePose.hop(self.T_camera_before[row], self.covariance[row], self.bias[row])

    def known(self, row: int) -> Matrix | None:
        """Return the covariance [6, 6] that tracking estimated for one hop, with its bias; None if it is not known."""
        return self.hop(row).total_covariance


@dataclass(frozen=True, eq=False)
class SolvedGraph:
    """The edges that determined the final poses of keyframes, as numbers: a keyframe that submaps share is one node.

    node [K]: the node of each keyframe, −1: not in the graph. T_world_node [N, 4, 4], of which the first `fixed` are
    given. ends [E, 2]: nodes a and b of each edge; T_a_b [E, 4, 4]; information [E, 6, 6]: with the factor and weight
    of the solution; shared [E, 6, 9]: one standard deviation of each error that all edges share (`graph_errors`).
    """

    node: NDArray[np.int64]
    T_world_node: Matrix
    fixed: int
    ends: NDArray[np.int64]
    T_a_b: Matrix
    information: Matrix
    shared: Matrix


NUMBERS = 5
"""Columns before the motion, see `Edges.rows`."""
TRUSTED: tuple[Kind, ...] = ("odometry", "relocalisation", "join")
"""The kinds of edges that the pose graph does not judge."""
INFORMATION = slice(NUMBERS + 16, NUMBERS + 16 + 36)
DRIFT = slice(NUMBERS + 16 + 36, None)


@dataclass(eq=False)
class Edges(Records[RelativePose]):
    """Edges in their order. An edge is made when it is read.

    rows [E, 93]: a, b, row of the loop that the edge is, or −1 minus its place in
    `TRUSTED`, both keyframes, T_a_b, information and
    drift by rows.
    """

    POSE_COLUMNS: ClassVar[slice] = slice(NUMBERS, NUMBERS + 16)
    """The columns of `rows` that hold a pose."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, NUMBERS + 16 + 2 * 36))

    @staticmethod
    def of(known: Iterable[RelativePose]) -> "Edges":
        """Return edges in their order; each loop has row 0."""
        if isinstance(known, Edges):
            return known
        edges = Edges()
        for edge in known:
            edges.append(edge)
        return edges

    def append(self, edge: RelativePose, loop_row: int = 0) -> None:
        """Append an edge; loop_row: of a loop, its row among all pairs that were tried."""
        loop_row = -1 - TRUSTED.index(edge.kind) if edge.kind in TRUSTED else loop_row
        numbers, matrices = (edge.a, edge.b, loop_row, *edge.keyframes), (edge.T_a_b, edge.information, edge.drift)
        self.rows.append(np.concatenate([numbers, *(matrix.ravel() for matrix in matrices)]))

    @property
    def ends(self) -> NDArray[np.int64]:
        """Return a and b of each edge [E, 2]."""
        return np.asarray(self.rows.used[:, :2].astype(np.int64))

    @property
    def T_a_b(self) -> Matrix:
        """Return the motion of each edge [E, 4, 4]."""
        return self.rows.used[:, NUMBERS : NUMBERS + 16].reshape(-1, 4, 4).copy()

    @property
    def information(self) -> Matrix:
        """Return the information of each edge [E, 6, 6]."""
        return self.rows.used[:, INFORMATION].reshape(-1, 6, 6).copy()

    @property
    def keyframes(self) -> NDArray[np.int64]:
        """Return both keyframes of each edge [E, 2]."""
        return np.asarray(self.rows.used[:, 3:NUMBERS].astype(np.int64))

    @property
    def drift(self) -> Matrix:
        """Return the drift in each edge [E, 6, 6]."""
        return self.rows.used[:, DRIFT].reshape(-1, 6, 6).copy()

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """Return which edges are loops [E]."""
        return np.asarray(self.rows.used[:, 2] >= 0)

    def taken(self, chosen: NDArray[np.bool_]) -> "Edges":
        """Return a copy of some edges."""
        rows = self.rows.used[chosen]
        return Edges(Column(rows, len(rows)))

    def loop_rows(self, edges: Sequence[int]) -> NDArray[np.int64]:
        """Return the row of the loop that each of some edges is [n], below 0 for a trusted edge."""
        return np.asarray(self.rows.used[np.array(edges, np.intp), 2].astype(np.int64))

    def _record(self, i: int) -> RelativePose:
        row = self.rows.used[i].copy()
        a, b, loop_row, in_a, in_b = (int(number) for number in row[:NUMBERS].tolist())
        information, drift = (row[columns].reshape(6, 6) for columns in (INFORMATION, DRIFT))
        kind = "loop" if loop_row >= 0 else TRUSTED[-1 - loop_row]
        return RelativePose(a, b, row[self.POSE_COLUMNS].reshape(4, 4), information, kind, (in_a, in_b), drift)
