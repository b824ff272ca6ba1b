"""A triangle mesh, and functions to sample it, move it, select parts of it, and render its depth."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sigmasplat.data.camera import Camera
from sigmasplat.errors import SigmaSplatError
from sigmasplat.native import _core

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices [V, 3] m, world frame; faces [F, 3], counter-clockwise from outside; colors [V, 3] in [0, 1];
    depth_std_m [V]: standard deviation of the depth of the surface at each vertex, m; filled [V]: whether a vertex only
    closes a gap and was not seen.

    Raises SigmaSplatError on inconsistent shapes, values that are not finite, or faces with unknown vertices.
    """

    vertices: Floats
    faces: Indices
    colors: Floats | None = None
    depth_std_m: Floats | None = None
    filled: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        v, f, c = self.vertices, self.faces, self.colors
        if v.ndim != 2 or v.shape[1] != 3 or f.ndim != 2 or f.shape[1] != 3 or (c is not None and c.shape != v.shape):
            shapes = (v.shape, f.shape, None if c is None else c.shape)
            raise SigmaSplatError(f"a mesh needs vertices [V, 3], faces [F, 3], colors [V, 3], found {shapes}")
        for name, values in (("depth_std_m", self.depth_std_m), ("filled", self.filled)):
            if values is not None and values.shape != (len(v),):
                raise SigmaSplatError(f"a mesh with {len(v)} vertices needs {name} [V], found {values.shape}")
        if not np.isfinite(v).all() or not (c is None or np.isfinite(c).all()):
            raise SigmaSplatError("a mesh needs finite vertices and colors, found NaN or inf")
        if f.size and (f.min() < 0 or f.max() >= len(v)):
            raise SigmaSplatError(f"a mesh with {len(v)} vertices has faces with vertices {f.min()} to {f.max()}")

    @staticmethod
    def concatenated(parts: "list[Mesh]") -> "Mesh":
        """Combine meshes without colours into one; vertices are not merged."""
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
        vertices = [part.vertices for part in parts]
        return Mesh(np.concatenate([*vertices, np.empty((0, 3), np.float32)]),
                    np.concatenate([*faces, np.empty((0, 3), np.int32)]))  # fmt: skip

    @property
    def corners(self) -> Doubles:
        """Return the corners of each face [F, 3 corners, 3], m."""
        return self.vertices[self.faces].astype(np.float64)

    def areas(self) -> Doubles:
        """Return the area of each face [F], m²."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return 0.5 * np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))

    def normals(self) -> Doubles:
        """Return outward unit normals of the vertices [V, 3]: area-weighted means of the normals of their faces, 0
        without a face."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        across = np.cross(b - a, c - a)
        sums = np.stack(
            [np.bincount(self.faces.ravel(), np.repeat(across[:, k], 3), len(self.vertices)) for k in range(3)]
        )
        length = np.linalg.norm(sums, axis=0)
        return np.asarray(np.divide(sums, length, out=np.zeros(sums.shape), where=length > 0).T)

    def sampled(self, points: int, seed: int) -> Doubles:
        """Draw random points [points, 3], uniform over the area; no points if the area is 0."""
        rng, areas = np.random.default_rng(seed), self.areas()
        if not float(areas.sum()) > 0.0:
            return np.empty((0, 3))
        chosen = rng.choice(len(areas), points, p=areas / areas.sum())
        a, b, c = np.moveaxis(self.vertices[self.faces[chosen]].astype(np.float64), 1, 0)
        s, t = rng.uniform(size=(2, points, 1))
        s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)  # mirrored into the triangle
        return np.asarray(a + s * (b - a) + t * (c - a))

    def moved(self, T_new_old: Doubles) -> "Mesh":
        """Return the mesh moved by a rigid 4×4 transform."""
        vertices = self.vertices @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        return replace(self, vertices=vertices.astype(np.float32))

    def with_faces(self, keep: NDArray[np.bool_]) -> "Mesh":
        """Return the faces selected by a mask [F] with the vertices they use, in the same order."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), bool)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        colors, std = (None if values is None else values[used] for values in (self.colors, self.depth_std_m))
        return Mesh(self.vertices[used], number[faces], colors, std, None if self.filled is None else self.filled[used])

    def subdivided(self, largest_edge_m: float) -> "Mesh":
        """Return the same surface in faces without a longer edge; a mesh of small faces is returned unchanged.

        Each larger face is divided into four at the middle of its edges, until all are small. New vertices are not
        merged, and the result has no colours. Raises SigmaSplatError unless largest_edge_m > 0.
        """
        if not largest_edge_m > 0:
            raise SigmaSplatError(f"the largest edge must be more than 0 m, found {largest_edge_m}")
        large = self._longest_edges() > largest_edge_m
        if not large.any():
            return self
        small = [replace(self.with_faces(~large), colors=None, depth_std_m=None, filled=None)]
        mesh = self.with_faces(large)
        while len(mesh.faces):
            a, b, c = np.moveaxis(mesh.corners, 1, 0)
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            parts = np.stack([np.stack(part, 1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], 1)
            vertices = parts.reshape(-1, 3).astype(np.float32)
            mesh = Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
            large = mesh._longest_edges() > largest_edge_m
            small.append(mesh.with_faces(~large))
            mesh = mesh.with_faces(large)
        return Mesh.concatenated(small)

    def _longest_edges(self) -> Doubles:
        corners = self.corners
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        return np.asarray(lengths.max(1, initial=0.0))

    def without_small_parts(self, vertices: int, share: float = 0.0) -> "Mesh":
        """Remove connected parts of fewer than `vertices` vertices (VarSplat §7: 200) or of less than `share` of the
        area of the largest part, and vertices without a face."""
        if not len(self.faces):
            return self.with_faces(np.zeros(0, bool))
        start, end = self.faces[:, [0, 1]].ravel(), self.faces[:, [1, 2]].ravel()
        n = len(self.vertices)
        edges = coo_array((np.ones(len(start), bool), (start, end)), shape=(n, n))
        _, part = connected_components(edges, directed=False)
        area = np.bincount(part[self.faces[:, 0]], self.areas())
        return self.with_faces(((np.bincount(part) >= vertices) & (area >= share * area.max()))[part[self.faces[:, 0]]])


def mesh_depth(mesh: Mesh, camera: Camera, T_camera_world: Doubles, near_m: float = 0.02) -> tuple[Floats, Indices]:
    """Return depth [H, W] along the optical axis, m, 0 without a face, and the nearest face [H, W], −1 = none.

    Both sides of a face are visible; a face with a point closer than `near_m` is ignored, so faces near the camera
    should be small (`Mesh.subdivided`).
    """
    x, y, z = T_camera_world[:3, :3] @ mesh.vertices.T + T_camera_world[:3, 3:]
    ahead = np.maximum(z, near_m)
    u, v = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
    depth_m = np.empty((camera.height, camera.width), np.float32)
    face = np.empty((camera.height, camera.width), np.int32)
    faces = np.ascontiguousarray(mesh.faces)
    _core.mesh_depth(u, v, np.ascontiguousarray(z), faces, camera.width, camera.height, near_m, depth_m, face)
    return depth_m, face
