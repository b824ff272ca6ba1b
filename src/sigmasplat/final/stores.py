"""The finished submaps as the final map sees them: some of them, with other poses, exposures or masks, and with splats
that have moved with the keyframes that the graph has moved. The keyframes of a component are one graph, which is solved
after the last frame (`graph.keyframe_graph`)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera, between
from sigmasplat.data.field import GaussianField
from sigmasplat.data.relative_pose import RelativePose, SolvedGraph
from sigmasplat.data.submap import Picture, Submap, SubmapStore
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.graph_errors import shared_errors
from sigmasplat.graph.keyframe_graph import (
    APART,
    GrowingGraph,
    KeyframeSolution,
    edge_between,
    hop_between,
    partners,
    solve,
)
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class StorePart:
    """Some submaps of a store, numbered from 0 in the order of `members`."""

    store: SubmapStore
    members: Sequence[int]

    def __len__(self) -> int:
        return len(self.members)

    def load(self, index: int) -> Submap:
        return self.store.load(self.members[index])

    def picture(self, index: int, keyframe: int) -> Picture:
        return self.store.picture(self.members[index], keyframe)

    def probe(self, index: int, probe: int) -> Picture:
        return self.store.probe(self.members[index], probe)


@dataclass(frozen=True, eq=False)
class RefinedStore:
    """The submaps of a store as the final map sees them: with the poses of their keyframes that its refinement has
    moved, and with images in the exposure of the map. Probe views follow as frames do; their
    exposure is interpolated between those of keyframes.

    keyframe_poses: T_submap_camera [4, 4] of each submap's keyframes, None: not moved. The splats of the submaps fit
    the old poses. exposures: [K, 3, 2] of each submap's keyframes (`data.camera`), None: not fitted.
    """

    store: SubmapStore
    keyframe_poses: Sequence[Sequence[Matrix]] | None = None
    exposures: Sequence[Matrix] | None = None

    def __len__(self) -> int:
        return len(self.store)

    def load(self, index: int) -> Submap:
        return self.moved(self.store.load(index), index)

    def moved(self, submap: Submap, index: int) -> Submap:
        """Return a submap of the store with the moved poses."""
        if self.keyframe_poses is None:
            return submap
        poses, frames = np.array(self.keyframe_poses[index]).reshape(-1, 4, 4), np.array(submap.frames, np.int64)
        motions, at = poses @ se3.inverse(submap.T_submap_camera), np.array(submap.probe_frames, np.int64)
        keyframe = np.searchsorted(frames, at, side="right") - 1
        after = np.minimum(keyframe + 1, len(frames) - 1)
        share = (at - frames[keyframe]) / np.maximum(frames[after] - frames[keyframe], 1) * (after > keyframe)
        probes = se3.interpolated(motions[keyframe], motions[after], share) @ submap.T_submap_probe
        return replace(submap, T_submap_camera=poses, T_submap_probe=probes)

    def picture(self, index: int, keyframe: int) -> Picture:
        picture = self.store.picture(index, keyframe)
        return picture if self.exposures is None else picture.without_exposure(self.exposures[index][keyframe])

    def probe(self, index: int, probe: int) -> Picture:
        picture = self.store.probe(index, probe)
        if self.exposures is None:
            return picture
        submap = self.store.load(index)
        at = np.array(submap.probe_frames[probe : probe + 1])
        return picture.without_exposure(between(np.array(submap.frames), self.exposures[index], at)[0])


@dataclass(frozen=True, eq=False)
class FollowedStore(RefinedStore):
    """The submaps of a store with the keyframe poses of the graph: each splat has moved with the keyframe that sees it
    from nearest."""

    def load(self, index: int) -> Submap:
        """Return a submap with the moved poses and splats."""
        before = self.store.load(index)
        after = self.moved(before, index)
        return replace(
            after, field=followed(before.field, before.T_submap_camera, after.T_submap_camera, before.camera)
        )


def followed(field: GaussianField, T_before: Matrix, T_after: Matrix, camera: Camera) -> GaussianField:
    """Return splats that have moved with keyframes from T_before to T_after [K, 4, 4], T_submap_camera; the rows are in
    the order of the keyframes."""
    owner = nearest_view(field.means.double().numpy(), T_before, camera)
    motions = T_after @ se3.inverse(T_before)
    parts = (field.part(torch.from_numpy(owner == k)).moved(torch.from_numpy(motions[k])) for k in np.unique(owner))
    return GaussianField.side_by_side(parts) if len(field) else field


def nearest_view(points: Matrix, T_world_camera: Matrix, camera: Camera) -> NDArray[np.int64]:
    """Return for each point [N, 3] the nearest camera [K] that has it in its image, or the nearest if none has."""
    found, least = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for k, T_camera_world in enumerate(se3.inverse(T_world_camera)):
        x, y, z = T_camera_world[:3, :3] @ points.T + T_camera_world[:3, 3:]
        ahead = np.maximum(z, 1e-6)
        inside = (z > 0) & (np.abs(camera.fx * x / ahead + camera.cx - camera.width / 2) < camera.width / 2)
        inside &= np.abs(camera.fy * y / ahead + camera.cy - camera.height / 2) < camera.height / 2
        away = np.sqrt(x * x + y * y + z * z) + np.where(inside, 0.0, 1e6)
        found, least = np.where(away < least, k, found), np.minimum(away, least)
    return found


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


def solved_keyframes(
    atlas: Atlas, path: PathCovariance, store: StorePart, image: Callable[[int], Pyramid], graph: GrowingGraph,
    calibration: Matrix | None,
) -> tuple[FollowedStore, list[list[Matrix]]]:  # fmt: skip
    """Solve the whole graph of the keyframes of a component; return the submaps as it has moved them, and the new poses
    T_submap_camera [4, 4] of each submap's keyframes.

    Keyframes are aligned to those that they turned out to be near to; image: that of a row. The anchors of the submaps,
    but for the first one, move by the mean motion of their keyframes. The atlas keeps the graph, whose errors are those
    of the path. calibration: of `calibration_std`.
    """
    nodes = KeyframeNodes.of(path, {s: store.load(i).frames for i, s in enumerate(store.members)})
    T, aligned = nodes.T_world_keyframe, nodes.numbered(graph.edges)
    more = alignments(T, lambda node: image(int(nodes.rows[node])), graph.most, aligned)
    edges = [*nodes.edges(), *aligned, *more]
    solved = solve(T, edges, nodes.fixed)
    points = [] if calibration is None else [image(int(row)).points for row in nodes.rows]
    shared = shared_errors(edges, atlas.rates(nodes.frames), points, calibration)
    atlas.graph = nodes.solved(solved, edges, shared)
    poses, tracked = nodes.spread(solved.T_world_keyframe), nodes.spread(T)
    in_submaps = list[list[Matrix]]()
    for s in store.members:
        rows = path.keyframe_submap == s
        known = path.T_submap_keyframe[rows]
        if not np.array_equal(poses[rows], tracked[rows]):
            if s != store.members[0]:
                moved = se3.log_stack(se3.inverse(atlas.anchors[s]) @ poses[rows] @ se3.inverse(known)).mean(0)
                atlas.anchors[s] = se3.orthonormalise(atlas.anchors[s] @ se3.exp(moved))
            known = se3.orthonormalise(se3.inverse(atlas.anchors[s]) @ poses[rows])
        in_submaps.append(list(known))
    return FollowedStore(store, in_submaps), in_submaps
