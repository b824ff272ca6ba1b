"""The part of a large pose graph around a node: its nodes move, and their neighbours hold them in place."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.graph.pose_graph import PoseGraphSolution, optimise
from sigmasplat.types import Matrix

MOST_FREE = 100
"""A larger graph is solved in parts of this many nodes; a smaller one is always solved as a whole."""


@dataclass(eq=False)
class Incidence:
    """Which edges are at each node; kept up to date while edges are appended to a list, so that a part of a large graph
    is found without reading the whole one."""

    edges: Sequence[RelativePose]
    at: dict[int, "array[int]"] = field(default_factory=dict)
    ends: "array[int]" = field(default_factory=lambda: array("i"))
    """Both ends of each edge that was read."""

    def rows_at(self, node: int) -> list[int]:
        """Return the rows of the edges at a node, in the order of the edges."""
        for row in range(len(self.ends) // 2, len(self.edges)):
            edge = self.edges[row]
            for end in (edge.a, edge.b):
                self.at.setdefault(end, array("i")).append(row)
                self.ends.append(end)
        return list(self.at.get(node, ()))

    def ends_of(self, row: int) -> tuple[int, int]:
        """Return both ends of an edge that `rows_at` has returned."""
        return self.ends[2 * row], self.ends[2 * row + 1]

    def other_end(self, row: int, node: int) -> int:
        """Return the end of an edge that is not the node."""
        a, b = self.ends_of(row)
        return b if a == node else a


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """A part of a graph. nodes: their numbers in the graph, the fixed ones first; fixed: how many these are; edges:
    rows of the graph's edges with at least one free end."""

    nodes: tuple[int, ...]
    fixed: int
    edges: tuple[int, ...]

    @staticmethod
    def whole(nodes: Sequence[int], edges: Sequence[RelativePose]) -> "Neighbourhood":
        """Return the whole graph of some nodes, the first of them fixed."""
        inside = set(nodes)
        return Neighbourhood(tuple(nodes), 1, tuple(row for row, edge in enumerate(edges) if edge.a in inside))

    @staticmethod
    def around(centre: int, graph: Incidence, always_fixed: int, most_free: int = MOST_FREE) -> "Neighbourhood":
        """Return the `most_free` nodes that are the fewest edges away from a centre, with their neighbours fixed.

        The node `always_fixed` is never free. The time taken depends on the part, not on the whole graph.
        """
        order, seen = [centre], {centre}
        for node in order:
            if len(order) > most_free:  # always_fixed may be one of them
                break
            for row in graph.rows_at(node):
                other = graph.other_end(row, node)
                if other not in seen:
                    seen.add(other)
                    order.append(other)
        free = sorted([node for node in order if node != always_fixed][:most_free])
        rows = sorted({row for node in free for row in graph.rows_at(node)})
        ends = {end for row in rows for end in graph.ends_of(row)}
        fixed = sorted(ends.difference(free))
        return Neighbourhood((*fixed, *free), len(fixed), tuple(rows))

    def solve(
        self, T_world_node: Sequence[Matrix], edges: Sequence[RelativePose], rejected: Sequence[bool] = ()
    ) -> PoseGraphSolution:
        """Solve this part of a graph, given the pose [4, 4] of each node and the edges; the solution has one pose for
        each of `nodes`. rejected: for each of this part's edges, as in `optimise`."""
        part = numbered([edges[row] for row in self.edges], self.nodes)
        poses = np.stack([T_world_node[node] for node in self.nodes])
        return optimise(poses, part, fixed=self.fixed, rejected=rejected)


def numbered(edges: Sequence[RelativePose], nodes: Sequence[int]) -> list[RelativePose]:
    """Return edges with each node replaced by its place in `nodes`."""
    number = {node: i for i, node in enumerate(nodes)}
    return [replace(edge, a=number[edge.a], b=number[edge.b]) for edge in edges]
