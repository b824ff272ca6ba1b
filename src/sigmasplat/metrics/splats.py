"""Hold the centres of splats against the true surface (CG-SLAM's Chamfer distance), and count those that float."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sigmasplat.metrics.reconstruction import POINTS, Doubles, distances, seen
from sigmasplat.model.camera import Camera
from sigmasplat.model.mesh import Mesh

OPAQUE = 0.1
"""A splat of more than this opacity can be a floater …"""
FLOATER_M = 0.1
"""… if its centre lies further than this from every true surface."""


@dataclass(frozen=True)
class SplatSurface:
    """Distances in metres, floaters as a share in [0, 1]; nan or inf where there is nothing to measure.

    splats_accuracy_m: mean distance from a splat's centre to the true surface; splats_completion_m: from the true
    surface to the nearest centre; splats_chamfer_m: mean of the two; floaters: share of the opaque splats that float.
    """

    splats_accuracy_m: float
    splats_completion_m: float
    splats_chamfer_m: float
    floaters: float


def splats_to_surface(
    centers: Doubles,
    opacities: Doubles,
    truth: Mesh,
    camera: Camera,
    T_world_camera: Doubles,
    *,
    points: int = POINTS,
    seed: int = 0,
) -> SplatSurface:
    """Hold splats, centers [N, 3] m and opacities [N], against the truth, in its frame, seen from true poses [K, 4, 4].

    Chamfer takes splats of every opacity, and of both sides what a training view could see (`reconstruction.score`). It
    is never 0: centres have gaps between them. Floaters are judged by the whole surface, those hidden behind it too.
    """
    seen_true, seen_splats = seen(truth, centers, camera, T_world_camera)
    theirs, ours = truth.with_faces(seen_true), centers[seen_splats]
    accuracy, completion = _mean(distances(ours, theirs)), _mean(_to_nearest(theirs.sampled(points, seed), ours))
    floating = distances(centers[opacities > OPAQUE], truth) > FLOATER_M
    return SplatSurface(accuracy, completion, (accuracy + completion) / 2, _mean(floating.astype(np.float64)))


def _to_nearest(points: Doubles, centers: Doubles) -> Doubles:
    """Return the distance [P] of each point to the nearest centre, inf where there are none."""
    if not len(centers):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(centers).query(points)[0])


def _mean(values: Doubles) -> float:
    return float(values.mean()) if values.size else float("nan")
