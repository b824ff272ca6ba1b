"""All edges of the pose graphs, in a column."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.data.relative_pose import Kind, RelativePose
from sigmasplat.types import Matrix

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
