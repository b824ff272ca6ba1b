"""All edges of the pose graphs, in a column."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.graph.pose_graph import Edge
from sigmasplat.types import Matrix

NUMBERS = 5
"""Columns before the motion, see `Edges.rows`."""
INFORMATION = slice(NUMBERS + 16, NUMBERS + 16 + 36)
DRIFT = slice(NUMBERS + 16 + 36, None)


@dataclass(eq=False)
class Edges(Records[Edge]):
    """Edges in their order. An edge is made when it is read.

    rows [E, 93]: a, b, row of the loop that the edge is, −1 for a trusted edge, both keyframes, T_a_b, information and
    drift by rows.
    """

    POSE_COLUMNS: ClassVar[slice] = slice(NUMBERS, NUMBERS + 16)
    """The columns of `rows` that hold a pose."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, NUMBERS + 16 + 2 * 36))

    @staticmethod
    def of(known: Iterable[Edge]) -> "Edges":
        """Return edges in their order; each loop has row 0."""
        if isinstance(known, Edges):
            return known
        edges = Edges()
        for edge in known:
            edges.append(edge, 0 if edge.loop else -1)
        return edges

    def append(self, edge: Edge, loop_row: int = -1) -> None:
        """Append an edge; loop_row: of a loop, its row among all pairs that were tried."""
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
        """Return the row of the loop that each of some edges is [n], −1 for a trusted edge."""
        return np.asarray(self.rows.used[np.array(edges, np.intp), 2].astype(np.int64))

    def _record(self, i: int) -> Edge:
        row = self.rows.used[i].copy()
        a, b, loop_row, in_a, in_b = (int(number) for number in row[:NUMBERS].tolist())
        information, drift = (row[columns].reshape(6, 6) for columns in (INFORMATION, DRIFT))
        return Edge(a, b, row[self.POSE_COLUMNS].reshape(4, 4), information, loop_row >= 0, (in_a, in_b), drift)
