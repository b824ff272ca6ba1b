"""Reduce a mesh to a number of triangles: quadric edge collapse (Garland and Heckbert 1997), by fast-simplification."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sigmasplat.data.mesh import Mesh
from sigmasplat.errors import ConfigError

TRIANGLES = 300_000
"""Default number of triangles of a mesh for viewers."""
AGGRESSIVENESS = 5.0
"""Of fast-simplification, 0 to 10: lower values keep the shape better and take longer."""


def refuse_budget(triangles: int) -> None:
    """Raise ConfigError if a number of triangles is negative."""
    if triangles < 0:
        raise ConfigError(f"--triangles must be at least 0 (0 = all), found {triangles}")


def decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most `triangles` triangles; a mesh that has no more is returned unchanged.

    Flat parts get few large triangles, so the surface moves little. The colour and depth_std_m of a vertex are the
    means of those of the original vertices that are nearest to it. triangles = 0 keeps all. Raises ConfigError if
    triangles is negative.
    """
    refuse_budget(triangles)
    if not triangles or len(mesh.faces) <= triangles:
        return mesh
    from fast_simplification import simplify

    vertices, faces = simplify(mesh.vertices.astype(np.float64), mesh.faces, target_count=triangles, agg=AGGRESSIVENESS)
    small = Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32))
    small = small.with_faces(small.areas() > 0.0)
    if not len(small.vertices):
        return small
    _, nearest = cKDTree(small.vertices).query(mesh.vertices)
    _, own = cKDTree(mesh.vertices).query(small.vertices)
    count = np.bincount(nearest, minlength=len(small.vertices))

    def averaged(values: NDArray[np.float32]) -> NDArray[np.float32]:
        sums = np.bincount(nearest, values, len(small.vertices))
        return np.where(count > 0, sums / np.maximum(count, 1), values[own]).astype(np.float32)

    colors = None if mesh.colors is None else np.stack([averaged(channel) for channel in mesh.colors.T], 1)
    std = None if mesh.depth_std_m is None else averaged(mesh.depth_std_m)
    filled = None if mesh.filled is None else averaged(mesh.filled.astype(np.float32)) > 0.5
    return Mesh(small.vertices, small.faces, colors, std, filled)
