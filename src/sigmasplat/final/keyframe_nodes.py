"""The keyframes of a whole component as one graph, which is solved after the last frame (`graph.keyframe_graph`)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.relative_pose import RelativePose, SolvedGraph
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.keyframe_graph import APART, KeyframeSolution, edge_between, hop_between, partners
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.types import Matrix


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
                found.append(hop_between(a, b, path.hops[row], se3.inverse(T[row]) @ T[row - 1]))
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
