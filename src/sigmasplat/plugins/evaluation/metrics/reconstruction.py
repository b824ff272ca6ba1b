"""Score a mesh against the true surface, as iMAP and NICE-SLAM do: only parts that a camera of the run could see count.

Distances are measured from points sampled on one surface to the other *surface*, not to points sampled on it. Two
samples of the same room with 200 000 points each are about a centimetre apart, more than the errors of a good map.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sigmasplat.api import Camera, Matrix, Mesh, Progress, mesh_depth, no_progress, se3

Mask = NDArray[np.bool_]

POINTS, POINTS_AT_ONCE, CANDIDATES = 200_000, 20_000, 8
"""Points sampled on each surface, and measured at once; faces tested for each: those with the nearest centroids."""
COMPLETE_M, CORRECT_M = 0.05, 0.01
"""Completion ratio: the share of the true surface with a reconstructed surface within the first distance. Precision,
recall and F1 use the second one."""
SLACK_M, BEHIND_M = 0.005, 0.05
"""A true face may be smaller than a pixel and lie between pixel centres. It is also visible if its centre is at most
this far behind the rendered depth. A reconstructed face more than this far behind the true surface is hidden."""


def score(
    found: Mesh, truth: Mesh, camera: Camera, T_world_camera: Matrix, *, points: int = POINTS, seed: int = 0,
    seen: tuple[Mask, Mask] | None = None,
) -> dict[str, float]:  # fmt: skip
    """Score mesh `found` against mesh `truth`, both in the frame of the truth, as seen from true poses [K, 4, 4].

    accuracy_m: mean distance from the reconstruction to the true surface; completion_m: from the true surface to the
    reconstruction; completion_ratio: share of the true surface within 5 cm of the reconstruction; and `correct`.

    The true faces should be small (a few cm). A true face counts if a training view shows it at a pixel, or if its
    centre is at most `SLACK_M` behind the depth rendered there. A reconstructed face counts if its centre is in a
    training view and at most `BEHIND_M` behind the true surface. `seen` gives both if they are known (`visible_parts`).
    Scores without data are nan.
    """
    seen_true, seen_found = seen or visible_parts(truth, found.corners.mean(1), camera, T_world_camera)
    ours, theirs = found.with_faces(seen_found), truth.with_faces(seen_true)
    to_truth = distances(ours.sampled(points, seed), theirs)
    to_found = distances(theirs.sampled(points, seed + 1), ours)
    found_m = {"accuracy_m": mean(to_truth), "completion_m": mean(to_found)}
    return found_m | {"completion_ratio": share(to_found, COMPLETE_M)} | correct(to_truth, to_found)


def visible_parts(
    truth: Mesh, points: Matrix, camera: Camera, T_world_camera: Matrix, progress: Progress = no_progress
) -> tuple[Mask, Mask]:
    """Return which faces [F] of the truth and which points [N] of the map are visible from poses [K, 4, 4].

    `score` describes the rules. Calls `progress(views done, total)`.
    """
    seen_true, seen_points = np.zeros(len(truth.faces), bool), np.zeros(len(points), bool)
    centers = truth.corners.mean(1)
    for done, T in enumerate(T_world_camera, 1):
        depth_m, face = mesh_depth(truth, camera, se3.inverse(T))
        seen_true[face[face >= 0]] = True
        seen_true |= visible_points(centers, depth_m, camera, T, SLACK_M)
        seen_points |= visible_points(points, depth_m, camera, T, BEHIND_M)
        progress(done, len(T_world_camera))
    return seen_true, seen_points


def correct(to_truth_m: Matrix, to_found_m: Matrix) -> dict[str, float]:
    """Return precision and recall, the shares of the reconstruction and of the true surface within 1 cm of the other,
    and f1, their harmonic mean; 0 if both are 0."""
    precision, recall = share(to_truth_m, CORRECT_M), share(to_found_m, CORRECT_M)
    both = precision + recall
    return {"precision": precision, "recall": recall, "f1": 2 * precision * recall / both if both > 0 else 0.0 * both}


def visible_points(
    points: Matrix, depth_m: NDArray[np.float32], camera: Camera, T_world_camera: Matrix, slack_m: float
) -> Mask:
    """Return which points [N, 3] a camera sees: inside its image and at most `slack_m` behind the depth [H, W].

    A pixel with depth 0 hides nothing.
    """
    T = se3.inverse(T_world_camera)
    x, y, z = T[:3, :3] @ points.T + T[:3, 3:]
    ahead = np.maximum(z, 1e-6)
    u, v = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = np.flatnonzero((z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
    seen = np.zeros(len(points), bool)
    there = depth_m[v[inside].astype(np.intp), u[inside].astype(np.intp)]
    seen[inside] = (there == 0) | (z[inside] <= there + slack_m)
    return seen


def distances(points: Matrix, mesh: Mesh) -> Matrix:
    """Return the distance [N] of each point to the nearest face of the mesh; inf if the mesh has no face."""
    if not len(mesh.faces) or not len(points):
        return np.full(len(points), np.inf)
    corners = mesh.corners
    _, near = cKDTree(corners.mean(1)).query(points, min(CANDIDATES, len(corners)))
    near = near.reshape(len(points), -1)
    out = np.empty(len(points))
    for start in range(0, len(points), POINTS_AT_ONCE):
        rows = slice(start, start + POINTS_AT_ONCE)
        squared = _squared_distance(points[rows, None], *np.moveaxis(corners[near[rows]], 2, 0))
        out[rows] = np.sqrt(squared.min(1))
    return out


def _squared_distance(p: Matrix, a: Matrix, b: Matrix, c: Matrix) -> Matrix:
    """Return squared distances [...] of points to triangles [..., 3].

    This is the distance to the plane if the point projects into the triangle, else to the nearest edge.
    """
    edges = [(a, b - a), (b, c - b), (c, a - c)]
    normal = np.cross(b - a, c - a)
    to_edges, above = np.full(normal.shape[:-1], np.inf), _dot(normal, normal) > 0
    for start, along in edges:
        q = p - start
        share = np.clip(_dot(q, along) / np.maximum(_dot(along, along), 1e-24), 0.0, 1.0)
        rest = q - share[..., None] * along
        to_edges = np.minimum(to_edges, _dot(rest, rest))
        above &= _dot(np.cross(along, q), normal) >= 0
    to_plane = _dot(p - a, normal) ** 2 / np.maximum(_dot(normal, normal), 1e-24)
    return np.where(above, np.minimum(to_plane, to_edges), to_edges)


def _dot(a: Matrix, b: Matrix) -> Matrix:
    return np.asarray(np.einsum("...k,...k->...", a, b))


def mean(values: Matrix) -> float:
    """Return the mean; nan without values."""
    return float(values.mean()) if values.size else float("nan")


def share(distance_m: Matrix, limit_m: float) -> float:
    """Return the share of distances below a limit; nan without distances."""
    return float((distance_m < limit_m).mean()) if distance_m.size else float("nan")


OPAQUE, FLOATER_M = 0.1, 0.1
"""A floater is a splat above this opacity whose centre is farther than this from every true surface."""


def score_splats(
    centers: Matrix, opacities: Matrix, truth: Mesh, camera: Camera, T_world_camera: Matrix, *, points: int = POINTS,
    seed: int = 0, seen: tuple[Mask, Mask] | None = None,
) -> dict[str, float]:  # fmt: skip
    """Score splats, centers [N, 3] m and opacities [N], in the frame of the truth, as seen from true poses [K, 4, 4];
    nan or inf without data.

    splats_accuracy_m: mean distance from a splat centre to the true surface; splats_completion_m: from the true
    surface to the nearest splat centre; splats_chamfer_m: mean of the two; floaters: share of the opaque splats that
    are floaters. The Chamfer distance uses splats of every opacity, and only parts that a training view could see
    (`reconstruction.score`). It is never 0 because there are gaps between splat centres. Floaters are measured against
    the whole true surface, and splats hidden behind it count too. `seen`: the visible faces and splats, if known.
    """
    seen_true, seen_splats = seen or visible_parts(truth, centers, camera, T_world_camera)
    theirs, ours = truth.with_faces(seen_true), centers[seen_splats]
    accuracy, completion = mean(distances(ours, theirs)), mean(nearest_m(theirs.sampled(points, seed), ours))
    floating = distances(centers[opacities > OPAQUE], truth) > FLOATER_M
    return {
        "splats_accuracy_m": accuracy, "splats_completion_m": completion,
        "splats_chamfer_m": (accuracy + completion) / 2, "floaters": mean(floating.astype(np.float64)),
    }  # fmt: skip


def nearest_m(points: Matrix, among: Matrix) -> Matrix:
    """Return the distance [N] of each point to the nearest of `among` [M, 3]; inf if M = 0."""
    if not len(among):
        return np.full(len(points), np.inf)
    # This tree finds the same distances. It is faster for points that are far from every surface.
    return np.asarray(cKDTree(among, compact_nodes=False, balanced_tree=False).query(points)[0])
