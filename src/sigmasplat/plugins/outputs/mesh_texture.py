"""Give a mesh a texture: one atlas of charts by xatlas, and for each of its texels the mean colour of the keyframes.

The colours are those of the recorded images in the exposure of the map, hence without seams, or, without images,
renders of the map. A view counts by the fourth power of its pixels per area of the surface: nearly the best one alone,
without borders between views. A texel that no view shows has the colours of the vertices.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field as dataclass_field, replace
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates

from sigmasplat.api import (
    AGREE_SHARE,
    Camera,
    ConfigError,
    FusionView,
    Matrix,
    Mesh,
    Progress,
    Renderer,
    install_package,
    mesh_depth,
    no_progress,
    se3,
    silhouettes,
    unexposed,
)

SIZES, TEXEL_M, FILLED = (2048, 4096), 0.005, 0.75
"""Edges of an atlas; the larger one if a texel of the smaller one would be larger than this on the surface, which takes
about this share of the atlas."""
PADDING, JPEG_QUALITY = 2, 90
FACES_AT_ONCE = 1024
"""Faces that xatlas divides into charts at once: its time grows faster than their number."""
POWER, LEAST_COSINE, HIDDEN_SHARE, LEAST_WEIGHT = 4, 0.2, 0.02, 1e-20
"""Of views: the power of pixels per area; steeper ones do not count, nor points behind the surface by this share of the
depth; the weight of the colours of the vertices."""


@dataclass(frozen=True, eq=False)
class TexturedMesh(Mesh):
    """A mesh with a texture: uv [V, 2] in [0, 1], from the upper left corner of its image; image: the file, JPEG."""

    uv: NDArray[np.float32] = dataclass_field(default_factory=lambda: np.empty((0, 2), np.float32))
    image: bytes = b""


def textured(mesh: Mesh, views: Iterable[FusionView], total: int, renderer: Renderer, progress: Progress = no_progress
             ) -> TexturedMesh:  # fmt: skip
    """Return a mesh in the world with a texture of these views; vertices at the edges of charts are doubled.

    Calls `progress(views done, total)`. Raises ConfigError if xatlas is not installed.
    """
    size = SIZES[float(mesh.areas().sum()) > FILLED * (SIZES[0] * TEXEL_M) ** 2]
    mesh, uv = unwrapped(mesh, size)
    texels = _Texels.of(mesh, uv, size)
    sums = np.zeros((len(texels.faces), 4), np.float32)
    sums[:, :3], sums[:, 3] = LEAST_WEIGHT * texels.mean_of(mesh, mesh.colors), LEAST_WEIGHT
    for done, at in enumerate(views, 1):
        rows, colors, weight = _seen(at, mesh, texels, renderer)
        sums[rows] += np.column_stack([colors * weight[:, None], weight])
        progress(done, total)
    image = np.zeros((size * size, 3), np.uint8)
    image[texels.places] = np.rint(255.0 * sums[:, :3] / sums[:, 3:]).clip(0, 255)
    empty = np.ones(size * size, bool)
    empty[texels.places] = False
    nearest = distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
    file = BytesIO()
    Image.fromarray(image.reshape(size, size, 3)[tuple(nearest)]).save(file, "JPEG", quality=JPEG_QUALITY)
    return TexturedMesh(
        mesh.vertices, mesh.faces, mesh.colors, mesh.depth_std_m, mesh.filled, uv=uv, image=file.getvalue()
    )


def unwrapped(mesh: Mesh, size: int) -> tuple[Mesh, NDArray[np.float32]]:
    """Return the mesh with the vertices at the edges of charts doubled, and the place of each vertex in an atlas of
    size² texels [V, 2]. Raises ConfigError if xatlas is not installed."""
    try:
        import xatlas
    except ImportError as problem:
        raise ConfigError(
            f"a texture needs xatlas, which does not load ({problem}): {install_package('xatlas')}, "
            "or give --no-texture"
        ) from problem
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    parts = _parts(mesh.corners.mean(1))
    for part in parts:
        used, faces = np.unique(mesh.faces[part], return_inverse=True)
        atlas.add_mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), packing)
    found, start = [atlas[i] for i in range(len(parts))], 0
    rows, faces_of, uv = [], [], []
    for part, (vertices, faces, at) in zip(parts, found, strict=True):
        rows.append(np.unique(mesh.faces[part])[vertices])
        faces_of.append(faces.astype(np.int32) + np.int32(start))
        uv.append(np.clip(at, 0.0, 1.0))
        start += len(vertices)
    row = np.concatenate(rows)
    colors, std, filled = (None if of is None else of[row] for of in (mesh.colors, mesh.depth_std_m, mesh.filled))
    doubled = Mesh(mesh.vertices[row], np.concatenate(faces_of), colors, std, filled)
    return doubled, np.concatenate(uv).astype(np.float32)


def _parts(centers: Matrix) -> list[NDArray[np.int64]]:
    """Divide points [N, 3] at the median of their longest axis until each part has at most `FACES_AT_ONCE`."""
    open_parts, parts = [np.arange(len(centers))], []
    while open_parts:
        part = open_parts.pop()
        if len(part) <= FACES_AT_ONCE:
            parts.append(part)
            continue
        order = np.argsort(centers[part, np.ptp(centers[part], axis=0).argmax()], kind="stable")
        open_parts += [np.sort(part[half]) for half in np.array_split(order, 2)]
    return parts


@dataclass(frozen=True, eq=False)
class _Texels:
    """The T texels of an atlas that show a face, in the order of the faces: their places in the image, faces,
    barycentric coordinates [T, 3], positions [T, 3] m and normals [T, 3]."""

    places: NDArray[np.int64]
    faces: NDArray[np.int64]
    shares: NDArray[np.float32]
    points: NDArray[np.float32]
    normals: NDArray[np.float32]

    @staticmethod
    def of(mesh: Mesh, uv: NDArray[np.float32], size: int) -> "_Texels":
        """Draw the charts as a flat mesh one metre in front of a camera whose pixels are the texels."""
        flat = Mesh(np.column_stack([uv, np.ones(len(uv), np.float32)]).astype(np.float32), mesh.faces)
        _, shown = mesh_depth(flat, Camera(size, size, size, size, -0.5, -0.5), np.eye(4))
        places = np.flatnonzero(shown.ravel() >= 0)
        places = places[np.argsort(shown.ravel()[places], kind="stable")]
        faces = shown.ravel()[places].astype(np.int64)
        at = (np.stack([places % size, places // size], 1) + 0.5) / size
        a, b, c = np.moveaxis(uv[mesh.faces[faces]].astype(np.float64), 1, 0)
        whole = _cross(b - a, c - a)
        whole[whole == 0.0] = 1.0
        v, w = _cross(at - a, c - a) / whole, _cross(b - a, at - a) / whole
        shares = np.stack([1.0 - v - w, v, w], 1).astype(np.float32)
        texels = _Texels(places, faces, shares, np.empty(0, np.float32), np.empty(0, np.float32))
        points, normals = (
            texels.mean_of(mesh, values.astype(np.float32)) for values in (mesh.vertices, mesh.normals())
        )
        return replace(texels, points=points, normals=normals)

    def mean_of(self, mesh: Mesh, values: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """Interpolate values of the vertices [V, 3] at the texels [T, 3]; gray without values."""
        if values is None:
            return np.full((len(self.faces), 3), 0.7, np.float32)
        return np.asarray(np.einsum("tk,tkc->tc", self.shares, values[mesh.faces[self.faces]]), np.float32)


def _cross(a: Matrix, b: Matrix) -> Matrix:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _seen(
    at: FusionView, mesh: Mesh, texels: _Texels, renderer: Renderer
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Return the texels that a view shows [S], their colours there [S, 3] and their weights [S].

    Texels beside silhouettes do not count, nor where a reading contradicts the surface: something moved there.
    """
    T, camera = se3.inverse(at.T_world_camera), at.camera
    depth_m, face = mesh_depth(mesh, camera, T)
    known = (face >= 0) & ~silhouettes(depth_m)
    if at.picture is not None:
        reading_m = at.picture.depth_m
        known &= (reading_m == 0) | (np.abs(reading_m - depth_m) < AGREE_SHARE * depth_m)
    shown = np.zeros(len(mesh.faces), bool)
    shown[face[known]] = True
    rows = np.flatnonzero(shown[texels.faces])
    points = texels.points[rows] @ T[:3, :3].T + T[:3, 3]
    z, away = np.maximum(points[:, 2], 1e-6), np.linalg.norm(points, axis=1)
    u, v = (focal * points[:, k] / z + center for k, focal, center in ((0, camera.fx, camera.cx),
                                                                       (1, camera.fy, camera.cy)))  # fmt: skip
    cosine = np.abs(np.einsum("sk,sk->s", texels.normals[rows] @ T[:3, :3].T, points)) / away
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    use = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (cosine > LEAST_COSINE)
    row, column = row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)
    use &= known[row, column] & (z < (1.0 + HIDDEN_SHARE) * depth_m[row, column])
    image, of = _image(at, renderer)
    u, v = (of.fx * points[use, 0] / z[use] + of.cx, of.fy * points[use, 1] / z[use] + of.cy)
    colors = np.stack([map_coordinates(image[..., k], [v, u], order=1, mode="nearest") for k in range(3)], 1)
    weight = (cosine[use] / z[use] ** 2) ** POWER
    return rows[use], colors.astype(np.float32), weight.astype(np.float32)


def _image(at: FusionView, renderer: Renderer) -> tuple[NDArray[np.float32], Camera]:
    """Return the colours of a view [H, W, 3] in the exposure of the map, in [0, 1], and their camera."""
    if at.picture is None:
        seen = renderer(at.field, at.camera, at.T_camera_field)
        color, alpha = (np.asarray(values.cpu(), np.float32) for values in (seen.color, seen.alpha))
        return np.asarray(color / np.maximum(alpha, np.float32(0.5))[..., None], np.float32), at.camera
    photo = at.picture.photo
    color = at.picture.unit_color if photo is None else photo.color().astype(np.float32) / np.float32(255.0)
    camera = at.camera if photo is None else photo.camera
    return color if at.exposure is None else unexposed(color, at.exposure), camera
