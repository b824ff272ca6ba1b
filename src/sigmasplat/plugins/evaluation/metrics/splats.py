"""Measure the distance of splat centres to the true surface (CG-SLAM's Chamfer distance), and count floaters."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.evaluation.metrics.reconstruction import POINTS, Mask, distances, visible_parts
from sigmasplat.types import Matrix

OPAQUE = 0.1
"""Only a splat above this opacity can be a floater."""
FLOATER_M = 0.1
"""A floater is an opaque splat whose centre is farther than this from every true surface."""


@dataclass(frozen=True)
class SplatScores:
    """Scores of splat centres: distances in metres, shares in [0, 1]; nan or inf without data.

    splats_accuracy_m: mean distance from a splat centre to the true surface; splats_completion_m: from the true
    surface to the nearest splat centre; splats_chamfer_m: mean of the two; floaters: share of the opaque splats that
    are floaters.
    """

    splats_accuracy_m: float
    splats_completion_m: float
    splats_chamfer_m: float
    floaters: float


def score_splats(
    centers: Matrix,
    opacities: Matrix,
    truth: Mesh,
    camera: Camera,
    T_world_camera: Matrix,
    *,
    points: int = POINTS,
    seed: int = 0,
    seen: tuple[Mask, Mask] | None = None,
) -> SplatScores:
    """Score splats, centers [N, 3] m and opacities [N], in the frame of the truth, as seen from true poses [K, 4, 4].

    The Chamfer distance uses splats of every opacity, and only parts that a training view could see
    (`reconstruction.score`). It is never 0 because there are gaps between splat centres. Floaters are measured against
    the whole true surface, and splats hidden behind it count too. `seen`: the visible faces and splats, if known.
    """
    seen_true, seen_splats = seen or visible_parts(truth, centers, camera, T_world_camera)
    theirs, ours = truth.with_faces(seen_true), centers[seen_splats]
    accuracy, completion = _mean(distances(ours, theirs)), _mean(_to_nearest(theirs.sampled(points, seed), ours))
    floating = distances(centers[opacities > OPAQUE], truth) > FLOATER_M
    return SplatScores(accuracy, completion, (accuracy + completion) / 2, _mean(floating.astype(np.float64)))


def _to_nearest(points: Matrix, centers: Matrix) -> Matrix:
    """Return the distance [P] of each point to the nearest centre; inf if there is no centre."""
    if not len(centers):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(centers).query(points)[0])


def _mean(values: Matrix) -> float:
    return float(values.mean()) if values.size else float("nan")
