"""Score a mesh against the true surface by the protocol of published systems, to compare with their tables.

Accuracy, completion and its ratio: NICE-SLAM's evaluation, used by most RGB-D SLAM papers. F1: Point-SLAM's. Depth:
NICE-SLAM's random views inside the room. Distances are measured between points, so they are not 0 for a perfect mesh;
`reconstruction.score` measures distances to surfaces.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from sigmasplat.api import Camera, Matrix, Mesh, Progress, mesh_depth, no_progress, se3
from sigmasplat.plugins.evaluation.metrics.reconstruction import COMPLETE_M, POINTS, correct, mean, nearest_m, share
from sigmasplat.plugins.evaluation.metrics.trajectory import align_rigid
from sigmasplat.plugins.outputs.video import look_along

Mask = NDArray[np.bool_]

VIEWS = 1000
VIEW_CAMERA = Camera(500, 500, 300.0, 300.0, 249.5, 249.5)
BOX_SHARES = (0.3, 0.7, 0.7)
"""Random views are inside this share of the room's box along its sides, the shortest one first."""
UNSEEN_SHARE = 0.05
"""A random view with a larger share of pixels that show an unseen part of the true surface is drawn again."""
DRAWS_PER_VIEW = 4
ICP_REACH_M, ICP_ITERATIONS, ICP_STOP = 0.1, 30, 1e-6
FACETS = 500
"""At most this many facets of the convex hull are tried as a side of the box."""


def score_published(
    found: Mesh, truth: Mesh, seen_true: Mask, seen_found: Mask, *, points: int = POINTS, views: int = VIEWS,
    seed: int = 0, progress: Progress = no_progress,
) -> dict[str, float]:  # fmt: skip
    """Score mesh `found` against mesh `truth`, both in the frame of the truth, after aligning them by ICP: distances in
    metres, shares in [0, 1]; nan without data.

    accuracy_m, completion_m: mean distance from points on the reconstruction to points on the truth, and back;
    chamfer_m: the mean of the two; completion_ratio: share of the true points within 5 cm; precision, recall, f1: as
    in the papers at 1 cm, with as many points as the larger mesh has vertices; depth_l1_m: mean over random views of
    the mean |depth difference|; depth_views: number of these views. seen_true, seen_found: the faces of each that count
    (`reconstruction.visible_parts`). Calls `progress(views done, total)`.
    """
    ours, theirs = found.with_faces(seen_found), truth.with_faces(seen_true)
    T = aligned_by_icp(ours.vertices.astype(np.float64), theirs.vertices.astype(np.float64))
    ours = ours.moved(T)
    ours_sampled, theirs_sampled = ours.sampled(points, seed), theirs.sampled(points, seed + 1)
    accuracy, completion = nearest_m(ours_sampled, theirs_sampled), nearest_m(theirs_sampled, ours_sampled)
    dense = dense_points(ours, theirs, seed + 2)
    errors = depth_errors(ours, truth, seen_true, views=views, seed=seed, progress=progress)
    return {
        "accuracy_m": mean(accuracy), "completion_m": mean(completion),
        "chamfer_m": (mean(accuracy) + mean(completion)) / 2, "completion_ratio": share(completion, COMPLETE_M),
        **correct(nearest_m(*dense), nearest_m(*dense[::-1])), "depth_l1_m": mean(errors), "depth_views": len(errors),
    }  # fmt: skip


def dense_points(ours: Mesh, theirs: Mesh, seed: int) -> tuple[Matrix, Matrix]:
    """Return points of equal number on both meshes: the vertices of the one with more, and samples of the other."""
    if not len(ours.faces) or not len(theirs.faces):
        return np.empty((0, 3)), theirs.vertices.astype(np.float64)
    if len(theirs.vertices) < len(ours.vertices):
        return ours.vertices.astype(np.float64), theirs.sampled(len(ours.vertices), seed)
    return ours.sampled(len(theirs.vertices), seed), theirs.vertices.astype(np.float64)


def aligned_by_icp(points: Matrix, target: Matrix, most: int = POINTS) -> Matrix:
    """Return T_target_points [4, 4]: point-to-point ICP from the identity, with pairs up to `ICP_REACH_M` apart.

    It stops when the share of pairs and their RMS distance change by less than `ICP_STOP`. Uses every k-th point.
    """
    T = np.eye(4)
    if not len(points) or not len(target):
        return T
    points, tree, before = points[:: -(-len(points) // most)], cKDTree(target), (0.0, 0.0)
    for _ in range(ICP_ITERATIONS):
        found = tree.query(points @ T[:3, :3].T + T[:3, 3], distance_upper_bound=ICP_REACH_M)
        distance, row = np.asarray(found[0]), np.asarray(found[1])
        near = np.isfinite(distance)
        if near.sum() < 3:
            return T
        fit = float(near.mean()), float(np.sqrt(np.mean(distance[near] ** 2)))
        if all(abs(now - then) < ICP_STOP for now, then in zip(fit, before, strict=True)):
            break
        T, before = align_rigid(points[near], target[row[near]]), fit
    return T


def depth_errors(
    found: Mesh, truth: Mesh, seen_true: Mask, *, views: int = VIEWS, camera: Camera = VIEW_CAMERA, seed: int = 0,
    progress: Progress = no_progress,
) -> Matrix:  # fmt: skip
    """Return the mean |depth difference| of each random view, m, over pixels where both have a surface and the true
    one was seen."""
    errors = list[float]()
    for done, (T, depth_m, counted) in enumerate(random_views(truth, seen_true, views, camera, seed), 1):
        ours, _ = mesh_depth(found, camera, se3.inverse(T))
        both = counted & (ours > 0)
        if both.any():
            errors.append(float(np.abs(ours[both].astype(np.float64) - depth_m[both]).mean()))
        progress(done, views)
    return np.array(errors)


def random_views(
    truth: Mesh, seen_true: Mask, views: int, camera: Camera, seed: int
) -> Iterator[tuple[Matrix, NDArray[np.float32], Mask]]:
    """Yield at most `views` views inside the room: pose, true depth, and which pixels show a seen true face.

    Positions are uniform in the shrunk box of the seen surface, directions point to uniform points of a cube. Views
    that show too much unseen surface (`UNSEEN_SHARE`), or none that was seen, are left out. At most `DRAWS_PER_VIEW`
    views are drawn for each wanted one.
    """
    if not seen_true.any() or not views:
        return
    center, axes, sides = oriented_box(truth.with_faces(seen_true).vertices.astype(np.float64))
    rng, kept = np.random.default_rng(seed), 0
    for _ in range(DRAWS_PER_VIEW * views):
        place, toward = rng.uniform(-0.5, 0.5, (2, 3))
        forward = toward / np.linalg.norm(toward)
        T = look_along(center + axes @ (place * sides * BOX_SHARES), forward, axes[:, 0])
        depth_m, face = mesh_depth(truth, camera, se3.inverse(T))
        hit = face >= 0
        counted = hit & seen_true[face]
        if counted.any() and (hit & ~counted).mean() <= UNSEEN_SHARE:
            yield T, depth_m, counted
            kept += 1
        if kept == views:
            return


def oriented_box(points: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Return the box of least volume with a facet of the convex hull as a side: centre [3], axes as columns [3, 3],
    and lengths [3], the shortest first. Flat sets of points get a box along the axes of the world."""
    try:
        hull = ConvexHull(points)
        corners, normals = points[hull.vertices], np.unique(hull.equations[:, :3].round(6), axis=0)
    except QhullError:
        corners, normals = points, np.eye(3)
    boxes = (_box_along(corners, normal) for normal in normals[:: -(-len(normals) // FACETS)])
    center, axes, sides = min(boxes, key=lambda box: float(box[2].prod()))
    order = np.argsort(sides, kind="stable")
    return center, axes[:, order], sides[order]


def _box_along(points: Matrix, normal: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Return the smallest box with one axis along `normal`: centre, axes and lengths."""
    z = normal / np.linalg.norm(normal)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    plane = np.stack([x, np.cross(z, x)], 1)
    flat, height = points @ plane, points @ z
    middle, lengths, angle_deg = cv2.minAreaRect(flat.astype(np.float32))
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    axes = np.concatenate([plane @ np.array([[c, -s], [s, c]]), z[:, None]], 1)
    center = plane @ np.array(middle) + z * (height.min() + height.max()) / 2
    return center, axes, np.array([*lengths, height.max() - height.min()])
