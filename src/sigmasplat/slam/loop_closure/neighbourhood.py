"""The part of a large pose graph around a node: its nodes move, and their neighbours hold them in place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from sigmasplat.slam.loop_closure.pose_graph import Edge, PoseGraphSolution, optimise
from sigmasplat.types import Matrix

MOST_FREE = 100
"""A larger graph is solved in parts of this many nodes; a smaller one is always solved as a whole."""


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """A part of a graph. nodes: their numbers in the graph, the fixed ones first; fixed: how many these are; edges:
    rows of the graph's edges with at least one free end."""

    nodes: tuple[int, ...]
    fixed: int
    edges: tuple[int, ...]

    @staticmethod
    def of(
        nodes: Sequence[int], edges: Sequence[Edge], centre: int | None = None, most_free: int = MOST_FREE
    ) -> "Neighbourhood":
        """Return the `most_free` nodes that are the fewest edges away from a centre, with their neighbours fixed.

        The result is the whole graph without a centre, or if it is not larger. The first of `nodes` is always fixed.
        """
        if centre is None or len(nodes) <= most_free:
            return Neighbourhood(tuple(nodes), 1, tuple(range(len(edges))))
        size = max(nodes) + 1
        a, b = np.array([(edge.a, edge.b) for edge in edges], np.intp).T
        adjacent = coo_array((np.ones(len(a)), (a, b)), shape=(size, size)).tocsr()
        order = breadth_first_order(adjacent, centre, directed=False, return_predecessors=False)
        free, touched = np.zeros(size, bool), np.zeros(size, bool)
        free[order[order != nodes[0]][:most_free]] = True
        inside = free[a] | free[b]
        touched[a[inside]] = touched[b[inside]] = True
        fixed, moving = np.flatnonzero(touched & ~free), np.flatnonzero(free)
        numbers = tuple(int(node) for node in (*fixed, *moving))
        return Neighbourhood(numbers, len(fixed), tuple(int(row) for row in np.flatnonzero(inside)))

    def solve(self, T_world_node: Sequence[Matrix], edges: Sequence[Edge]) -> PoseGraphSolution:
        """Solve this part of a graph, given the pose [4, 4] of each node and the edges; the solution has one pose for
        each of `nodes`."""
        number = {node: i for i, node in enumerate(self.nodes)}
        rows = [edges[row] for row in self.edges]
        part = [replace(edge, a=number[edge.a], b=number[edge.b]) for edge in rows]
        return optimise(np.stack([T_world_node[node] for node in self.nodes]), part, fixed=self.fixed)
