"""Finished submaps after the graph of keyframes has moved their keyframes: the splats move with them."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import RefinedStore, StorePart, Submap
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import picture_images
from sigmasplat.graph.keyframe_graph import KeyframeNodes, alignments, solve
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

CACHE_BYTES = 1 << 28
"""Images of keyframes that are kept while the graph is made."""


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
    atlas: Atlas, path: PathCovariance, store: StorePart, view: View, most: int
) -> tuple[FollowedStore, list[list[Matrix]]]:
    """Align the keyframes of a component to each other (at most `most` each) and solve their graph; return the submaps
    as it has moved them, and the new poses T_submap_camera [4, 4] of each submap's keyframes.

    The anchors of the submaps, but for the first one, move by the mean motion of their keyframes.
    """
    camera = view.camera
    frames = {s: store.load(i).frames for i, s in enumerate(store.members)}
    nodes = KeyframeNodes.of(path, frames)

    @lru_cache(max(1, CACHE_BYTES // (16 * camera.width * camera.height)))
    def image(node: int) -> Pyramid:
        row = nodes.rows[node]
        submap = int(path.keyframe_submap[row])
        keyframe = int(row - np.searchsorted(path.keyframe_submap, submap))
        return picture_images(view, store.picture(store.members.index(submap), keyframe), camera)[1]

    T = nodes.T_world_keyframe
    edges = nodes.edges() + alignments(T, image, most)
    poses, tracked = nodes.spread(solve(T, edges, nodes.fixed).T_world_keyframe), nodes.spread(T)
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
