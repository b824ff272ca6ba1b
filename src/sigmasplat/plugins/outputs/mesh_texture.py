"""Give a mesh a texture: an atlas of charts by xatlas, whose texels have the colours of the keyframes' images.

The images are taken in the exposure of the map, so there are no seams; without images, renders of the map are used.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field as dataclass_field
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates

import sigmasplat.api as api
from sigmasplat.api import Camera, Config, FusionView, Mesh, se3

SIZES, TEXEL_M, FILLED = (2048, 4096), 0.005, 0.75
"""Edges of an atlas: the larger one if texels of the smaller one, of which this share is used, would be larger."""
PADDING, JPEG_QUALITY = 2, 90
FACES_AT_ONCE = 1024
"""Faces that xatlas divides into charts at once: its time grows faster than their number."""
POWER, LEAST_COSINE, HIDDEN_SHARE = 4, 0.2, 0.02
"""A view counts by this power of its pixels per area, nearly the best one alone but without borders; not if it is
steeper, or for points behind the surface by this share of the depth."""
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TexturedMesh(Mesh):
    """A mesh with uv [V, 2] in [0, 1], from the upper left corner of the texture; image: the texture as JPEG file."""

    uv: Floats = dataclass_field(default_factory=lambda: np.empty((0, 2), np.float32))
    image: bytes = b""


def vertex_colors(mesh: Mesh) -> Floats:
    """Return the colours of the vertices [V, 3] in [0, 1]; gray if the mesh has none."""
    return np.full(mesh.vertices.shape, 0.7, np.float32) if mesh.colors is None else mesh.colors


def textured(
    mesh: Mesh, views: Iterable[FusionView], total: int, config: Config, progress: api.Progress
) -> TexturedMesh:
    """Return a mesh in the world with a texture of these views; vertices at the edges of charts are doubled.

    Texels that no view shows have the colours of the vertices. Views without images are rendered with the settings of
    `config`. Calls `progress(views done, total)`. Raises ConfigError if xatlas is not installed.
    """
    size = SIZES[float(mesh.areas().sum()) > FILLED * (SIZES[0] * TEXEL_M) ** 2]
    mesh, uv = _unwrapped(mesh, size)
    places, faces, shares = _texels(mesh, uv, size)

    def at_texels(values: Floats) -> Floats:
        return np.asarray(np.einsum("tk,tkc->tc", shares, values[mesh.faces[faces]]), np.float32)

    points, sums = at_texels(mesh.vertices), np.zeros((len(faces), 4), np.float32)
    for done, at in enumerate(views, 1):
        rows, colors, weight = _seen(at, mesh, points, faces, config)
        sums[rows] += np.column_stack([colors * weight[:, None], weight])
        progress(done, total)
    colors = at_texels(vertex_colors(mesh))
    shown = np.where(sums[:, 3:] > 0, sums[:, :3] / np.maximum(sums[:, 3:], 1e-30), colors)
    image, empty = np.zeros((size * size, 3), np.uint8), np.ones(size * size, bool)
    image[places], empty[places] = np.rint(255.0 * shown).clip(0, 255), False
    nearest = distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
    file = BytesIO()
    Image.fromarray(image.reshape(size, size, 3)[tuple(nearest)]).save(file, "JPEG", quality=JPEG_QUALITY)
    return TexturedMesh(mesh.vertices, mesh.faces, mesh.colors, mesh.depth_std_m, mesh.filled, uv, file.getvalue())


def _unwrapped(mesh: Mesh, size: int) -> tuple[Mesh, Floats]:
    """Return the mesh with the vertices at the edges of charts doubled, and uv [V, 2] in an atlas of size² texels."""
    try:
        import xatlas
    except ImportError as problem:
        raise api.ConfigError(
            f"a texture needs xatlas, which does not load ({problem}): {api.install_package('xatlas')}, "
            "or give --no-texture"
        ) from problem
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    used = []
    for part in _parts(mesh.corners.mean(1)):
        rows, faces = np.unique(mesh.faces[part], return_inverse=True)
        atlas.add_mesh(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.uint32))
        used.append(rows)
    atlas.generate(xatlas.ChartOptions(), packing)
    parts = [atlas[i] for i in range(len(used))]
    row = np.concatenate([rows[part[0]] for rows, part in zip(used, parts, strict=True)])
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    faces = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=False)])
    colors, std, filled = (None if of is None else of[row] for of in (mesh.colors, mesh.depth_std_m, mesh.filled))
    uv = np.concatenate([part[2] for part in parts]).clip(0.0, 1.0)
    return Mesh(mesh.vertices[row], faces.astype(np.int32), colors, std, filled), uv.astype(np.float32)


def _parts(centers: api.Matrix) -> list[Indices]:
    """Halve points [N, 3] along their longest axis until no part has more than `FACES_AT_ONCE`."""
    parts = [np.arange(len(centers))]
    while max(map(len, parts)) > FACES_AT_ONCE:
        axes = [np.ptp(centers[part], axis=0).argmax() for part in parts]
        ordered = [part[np.argsort(centers[part, axis], kind="stable")] for part, axis in zip(parts, axes, strict=True)]
        parts = [half for part in ordered for half in np.array_split(part, 2)]
    return parts


def _texels(mesh: Mesh, uv: Floats, size: int) -> tuple[Indices, Indices, Floats]:
    """Return the texels of an atlas that show a face: places in the image [T], faces [T], shares of their corners
    [T, 3]. The charts are drawn as a flat mesh 1 m in front of a camera whose pixels are the texels."""
    flat = Mesh(np.column_stack([uv, np.ones(len(uv), np.float32)]), mesh.faces)
    _, shown = api.mesh_depth(flat, Camera(size, size, size, size, -0.5, -0.5), np.eye(4))
    places = np.flatnonzero(shown >= 0)
    faces = shown.ravel()[places].astype(np.int64)
    corners = np.moveaxis(flat.corners[faces], 1, 0) - np.column_stack([places % size + 0.5, places // size + 0.5,
                                                                        np.full(len(places), size)]) / size  # fmt: skip
    areas = np.stack([np.cross(corners[k - 2], corners[k - 1])[:, 2] for k in range(3)], 1)
    whole = areas.sum(1, keepdims=True)
    return places, faces, np.divide(areas, whole, out=np.full(areas.shape, 1 / 3), where=whole != 0).astype(np.float32)


def _seen(at: FusionView, mesh: Mesh, points: Floats, faces: Indices, config: Config) -> tuple[Indices, Floats, Floats]:
    """Return which of the texels at `points` [T, 3] a view shows [S], their colours there [S, 3] and weights [S].

    Texels beside silhouettes do not count, nor where a reading contradicts the surface: something moved there.
    """
    camera, T, image, of = at.camera, se3.inverse(at.T_world_camera), *_image(at, config)
    depth_m, face = api.mesh_depth(mesh, camera, T)
    known = (face >= 0) & ~api.silhouettes(depth_m)
    if at.picture is not None:
        off_m = np.abs(at.picture.depth_m - depth_m)
        known &= (at.picture.depth_m == 0) | (off_m < api.AGREE_SHARE * depth_m)
    a, b, c = np.moveaxis(mesh.corners @ T[:3, :3].T + T[:3, 3], 1, 0)
    normal = np.cross(b - a, c - a)
    cosine = np.abs((normal * a).sum(1)) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(a, axis=1) + 1e-30)
    shown = np.zeros(len(mesh.faces), bool)
    shown[face[known]] = True
    rows = np.flatnonzero((shown & (cosine > LEAST_COSINE))[faces])
    x, y, z = T[:3, :3] @ points[rows].T + T[:3, 3:]
    u, v = (np.rint(f * s / np.maximum(z, 1e-6) + middle).astype(np.int64).clip(-1, most) for f, s, middle, most in (
        (camera.fx, x, camera.cx, camera.width), (camera.fy, y, camera.cy, camera.height)))  # fmt: skip
    nearest_m = np.pad(np.where(known, depth_m, np.float32(0.0)), 1)[v + 1, u + 1]
    use = (z > 0) & (z < (1.0 + HIDDEN_SHARE) * nearest_m)
    x, y, z, rows = x[use], y[use], z[use], rows[use]
    pixels = [of.fy * y / z + of.cy, of.fx * x / z + of.cx]
    colors = np.stack([map_coordinates(image[..., k], pixels, order=1, mode="nearest") for k in range(3)], 1)
    return rows, colors, ((cosine[faces[rows]] / z**2) ** POWER).astype(np.float32)


def _image(at: FusionView, config: Config) -> tuple[Floats, Camera]:
    """Return the colours of a view [H, W, 3] in the exposure of the map, in [0, 1], and their camera."""
    if at.picture is None:
        seen = api.FieldRenderer(config.render, config.backend)(at.field, at.camera, at.T_camera_field)
        return api.surface_of(seen, config)[1], at.camera
    photo, color, camera = at.picture.photo, at.picture.unit_color, at.camera
    if photo is not None:
        color, camera = photo.color().astype(np.float32) / np.float32(255.0), photo.camera
    return color if at.exposure is None else api.unexposed(color, at.exposure), camera
