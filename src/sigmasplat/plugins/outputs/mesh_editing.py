"""Close small gaps of a mesh, and reduce its number of triangles.

A patch of a gap has the connectivity of a disc, minimises the bending over itself and its edge (the square of the
Laplacian, as in Botsch and Kobbelt 2004), and is marked: nobody has seen it. Triangles are reduced by quadric edge
collapse (Garland and Heckbert 1997), by fast-simplification.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.distance import pdist

from sigmasplat.api import Matrix, Mesh

Indices = NDArray[np.int64]

STD_PER_M = 0.5
"""Standard deviation of a patch, added per distance from the seen edge: the surface may bend by about 27°."""
MOST_POINTS = 4000
"""Largest number of points inside one patch."""
ROUNDS, LEAST_LENGTH = 4, 0.3
"""Times a patch is placed, each time with the lengths of its edges found before; shorter ones count as this share of
the median."""
OUTWARD = 0.3
"""Mean cosine between the surface beside an edge and the direction away from the middle of the loop. It is 1 around a
hole in a plane, 0 at the rim of a cup, and −1 at the outer border of a part."""


class Patch(NamedTuple):
    """A patch of a loop: numbers of the loop's vertices [n]; positions of the new ones [m, 3]; faces [f, 3] with the
    numbers 0 … n − 1 for the loop and n … n + m − 1 for the new ones; colours and standard deviations of the new ones,
    None if the mesh has none."""

    loop: Indices
    vertices: Matrix
    faces: Indices
    colors: Matrix | None
    depth_std_m: Matrix | None


def filled(mesh: Mesh, largest_m: float) -> Mesh:
    """Return the mesh with its gaps closed whose vertices are at most `largest_m` apart; larger ones stay open.

    New vertices follow the others. They have the colours of the edge, a standard deviation that grows with the distance
    from it (if the mesh has any), and `Mesh.filled` true. Outer borders and rims stay open. largest_m = 0 closes none.
    """
    if not largest_m > 0 or not len(mesh.faces):
        return mesh
    neighbours = _neighbours(mesh.faces.astype(np.int64), len(mesh.vertices))
    patches = [_patch(mesh, loop, neighbours) for loop in gaps(mesh, largest_m)]
    return _joined(mesh, [patch for patch in patches if patch is not None])


def gaps(mesh: Mesh, largest_m: float) -> list[Indices]:
    """Return the loops around gaps that are at most `largest_m` across, in the order of a patch's border."""
    beside = _border(mesh)
    found = []
    for loop in _loops(beside):
        points = mesh.vertices[loop].astype(np.float64)
        if len(loop) < 3 or (np.ptp(points, axis=0) > largest_m).any() or pdist(points).max() > largest_m:
            continue
        edges = zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)
        across, opposite = points - points.mean(0), mesh.vertices[[beside[edge] for edge in edges]]
        along = np.roll(points, -1, axis=0) - points
        away = opposite - points
        away -= along * (_dot(away, along) / np.maximum(_dot(along, along), 1e-18))[:, None]
        cosines = _dot(away, across) / np.maximum(np.linalg.norm(away, axis=1) * np.linalg.norm(across, axis=1), 1e-18)
        if cosines.mean() > OUTWARD:
            found.append(loop)
    return found


def _border(mesh: Mesh) -> dict[tuple[int, int], int]:
    """Return the directed edges of missing faces, each with the third vertex of the face on its other side."""
    faces = mesh.faces.astype(np.int64)
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    third, n = faces[:, [2, 0, 1]].ravel(), len(mesh.vertices)
    _, which, uses = np.unique(
        np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    return {(int(end[i]), int(start[i])): int(third[i]) for i in np.flatnonzero(uses[which] == 1)}


def _loops(edges: dict[tuple[int, int], int]) -> list[Indices]:
    """Follow directed edges to loops. Where loops touch at a vertex, they are separated there."""
    following = defaultdict[int, list[int]](list)
    for a, b in sorted(edges, reverse=True):
        following[a].append(b)
    loops = []
    for first in sorted(following):
        while following[first]:
            path, place = [first], {first: 0}
            while following[path[-1]]:
                at = following[path[-1]].pop()
                if at in place:
                    begin = place[at]
                    loops.append(np.array(path[begin:], np.int64))
                    for left in path[begin + 1 :]:
                        del place[left]
                    del path[begin + 1 :]
                    if len(path) == 1 and not following[first]:
                        break
                else:
                    place[at] = len(path)
                    path.append(at)
    return loops


def _patch(mesh: Mesh, loop: Indices, neighbours: csr_array) -> Patch | None:
    """Make the patch of a loop; None if the loop cannot be triangulated."""
    n = len(loop)
    disc, faces = _disc(n)
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    pairs, uses = np.unique(sides, axis=0, return_counts=True)
    if (uses == 1).sum() != n or pairs[uses == 1].max() >= n:
        return None
    if len(disc) == n:
        none = np.empty((0, 3))
        return Patch(loop, none, faces, none, none[:, 0])
    known = np.concatenate([loop, np.setdiff1d(neighbours[loop].indices, loop)])
    points = mesh.vertices[known].astype(np.float64)
    pairs = _pairs(_neighbours(faces, len(disc)), csr_array(neighbours[loop][:, known]))
    new = np.arange(n, len(disc))
    placed = np.concatenate([points[:n], np.zeros((len(new), 3)), points[n:]])
    lengths = np.ones(pairs.shape[1])
    for _ in range(ROUNDS):
        rows = _laplacian(pairs, lengths, len(disc), len(placed))
        free = rows[:, new]
        placed[new] = 0.0
        placed[new] = splu(csc_array(free.T @ free)).solve(-(free.T @ (rows @ placed)))
        lengths = np.linalg.norm(placed[pairs[0]] - placed[pairs[1]], axis=1)
        lengths = np.maximum(lengths, LEAST_LENGTH * np.median(lengths))
    membrane = splu(csc_array(rows[new][:, new]))

    def from_edge(values: NDArray[np.float32]) -> Matrix:
        return np.asarray(membrane.solve(-(rows[new][:, :n] @ values.astype(np.float64))))

    colors = None if mesh.colors is None else np.clip(from_edge(mesh.colors[loop]), 0.0, 1.0)
    std = None
    if mesh.depth_std_m is not None:
        distance, _ = cKDTree(points[:n]).query(placed[new])
        std = np.hypot(from_edge(mesh.depth_std_m[loop]), STD_PER_M * distance)
    return Patch(loop, placed[new], faces, colors, std)


def _disc(n: int) -> tuple[Matrix, Indices]:
    """Return n points on the unit circle followed by points inside it, equally dense, and triangles between them."""
    angle = 2.0 * np.pi * np.arange(n) / n
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    step = max(2.0 * np.pi / n, np.sqrt(2.0 * np.pi / np.sqrt(3.0) / MOST_POINTS))
    count = int(np.ceil(1.0 / step)) + 1
    row, column = np.mgrid[-2 * count : 2 * count + 1, -2 * count : 2 * count + 1].reshape(2, -1)
    grid = step * np.stack([column + 0.5 * row, row * np.sqrt(0.75)], 1) + step * np.array([0.137, 0.071])
    points = np.concatenate([circle, grid[np.linalg.norm(grid, axis=1) < 1.0 - 0.7 * step]])
    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((area > 0)[:, None], faces, faces[:, ::-1])
    return points, faces[np.abs(area) > 1e-9]


def _pairs(inside: csr_array, around: csr_array) -> Indices:
    """Return pairs of neighbours [2, P]: those inside a patch [n + m, n + m], and those of its loop in the mesh [n, n +
    others]. Numbers: first the loop, then new vertices, then other vertices beside the loop."""
    n, m = around.shape[0], inside.shape[0] - around.shape[0]
    (row, column), (of_loop, other) = inside.nonzero(), around.nonzero()
    other = np.where(other < n, other, other + m)
    both = np.concatenate([np.stack([row, column]), np.stack([of_loop, other])], axis=1)
    return np.unique(both, axis=1).astype(np.int64)  # an edge of the loop is in both


def _laplacian(pairs: Indices, lengths: Matrix, rows: int, columns: int) -> csc_array:
    """Return the mean of the vectors to the neighbours, each divided by its length [rows, columns]: on a smooth surface
    it is the curvature times the distance of the vertices, also if they are not equally dense."""
    row, column = pairs
    weight = 1.0 / (lengths * np.bincount(row, minlength=rows)[row])
    out = coo_array((weight, (row, column)), shape=(rows, columns))
    own = coo_array((np.bincount(row, weight, rows), (np.arange(rows), np.arange(rows))), shape=(rows, columns))
    return csc_array(out - own)


def _neighbours(faces: Indices, vertices: int) -> csr_array:
    """Return which vertices have an edge in common [V, V]."""
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    row, column = np.concatenate([start, end]), np.concatenate([end, start])
    return csr_array(coo_array((np.ones(len(row)), (row, column)), shape=(vertices, vertices)))


def _joined(mesh: Mesh, patches: list[Patch]) -> Mesh:
    if not patches:
        return mesh
    start, faces = len(mesh.vertices), [mesh.faces.astype(np.int64)]
    for patch in patches:
        faces.append(np.concatenate([patch.loop, start + np.arange(len(patch.vertices))])[patch.faces])
        start += len(patch.vertices)

    def with_new(name: str) -> NDArray[np.float32] | None:
        parts = [getattr(each, name) for each in (mesh, *patches)]
        return None if parts[0] is None else np.concatenate(parts).astype(np.float32)

    vertices = with_new("vertices")
    assert vertices is not None
    marks = np.zeros(len(mesh.vertices), bool) if mesh.filled is None else mesh.filled
    marks = np.concatenate([marks, np.ones(start - len(marks), bool)])
    return Mesh(vertices, np.concatenate(faces).astype(np.int32), with_new("colors"), with_new("depth_std_m"), marks)


def _dot(a: Matrix, b: Matrix) -> Matrix:
    return np.asarray(np.einsum("ij,ij->i", a, b))


AGGRESSIVENESS = 5.0
"""Of fast-simplification, 0 to 10: lower values keep the shape better and take longer."""


def decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most `triangles` triangles; a mesh that has no more is returned unchanged.

    Flat parts get few large triangles, so the surface moves little. The colour and depth_std_m of a vertex are the
    means of those of the original vertices that are nearest to it. triangles = 0 keeps all.
    """
    if triangles <= 0 or len(mesh.faces) <= triangles:
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

    colors = None if mesh.colors is None else np.stack([*map(averaged, mesh.colors.T)], 1)
    std = None if mesh.depth_std_m is None else averaged(mesh.depth_std_m)
    filled = None if mesh.filled is None else averaged(mesh.filled.astype(np.float32)) > 0.5
    return Mesh(small.vertices, small.faces, colors, std, filled)
