"""The finished submaps as the final map sees them: some of them, with other poses, exposures or masks, and with splats
that have moved with the keyframes that the graph has moved."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera, between
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import Picture, Submap, SubmapStore
from sigmasplat.final.keyframe_nodes import KeyframeNodes, alignments
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.graph_errors import shared_errors
from sigmasplat.graph.keyframe_graph import GrowingGraph, solve
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
    """Return for each point [N, 3] the camera [K] that has it in its image and is nearest; the nearest one if none
    has."""
    found, least = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for k, T_camera_world in enumerate(se3.inverse(T_world_camera)):
        x, y, z = T_camera_world[:3, :3] @ points.T + T_camera_world[:3, 3:]
        ahead = np.maximum(z, 1e-6)
        inside = (z > 0) & (np.abs(camera.fx * x / ahead + camera.cx - camera.width / 2) < camera.width / 2)
        inside &= np.abs(camera.fy * y / ahead + camera.cy - camera.height / 2) < camera.height / 2
        away = np.sqrt(x * x + y * y + z * z) + np.where(inside, 0.0, 1e6)
        found, least = np.where(away < least, k, found), np.minimum(away, least)
    return found


def solved_keyframes(
    atlas: Atlas,
    path: PathCovariance,
    store: StorePart,
    image: Callable[[int], Pyramid],
    graph: GrowingGraph,
    rendered: bool,
) -> tuple[FollowedStore, list[list[Matrix]]]:
    """Solve the whole graph of the keyframes of a component; return the submaps as it has moved them, and the new poses
    T_submap_camera [4, 4] of each submap's keyframes.

    Keyframes are aligned to those that they turned out to be near to; image: that of a row. The anchors of the submaps,
    but for the first one, move by the mean motion of their keyframes. The atlas keeps the graph, whose errors are those
    of the path. rendered: whether calibration and times are exact.
    """
    nodes = KeyframeNodes.of(path, {s: store.load(i).frames for i, s in enumerate(store.members)})
    T, aligned = nodes.T_world_keyframe, nodes.numbered(graph.edges)
    more = alignments(T, lambda node: image(int(nodes.rows[node])), graph.most, aligned)
    edges = [*nodes.edges(), *aligned, *more]
    solved = solve(T, edges, nodes.fixed)
    atlas.graph = nodes.solved(solved, edges, shared_errors(edges, atlas.rates(nodes.frames), rendered))
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
