"""Render a mesh from a camera: the depth and the face at each pixel."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.model.camera import Camera
from sigmasplat.model.mesh import Mesh

Doubles = NDArray[np.float64]
Rows = NDArray[np.intp]

NOTHING = np.uint64(0xFFFFFFFFFFFFFFFF)


def mesh_depth(
    mesh: Mesh, camera: Camera, T_camera_world: Doubles, near_m: float = 0.02
) -> tuple[NDArray[np.float32], Rows]:
    """Return depth [H, W] along the optical axis, m, 0 without a face, and the nearest face [H, W], −1 = none.

    Both sides of a face are visible; a face with a point closer than `near_m` is ignored. The cost is the number of
    pixels inside the faces' bounding boxes, so faces should be small in the image.
    """
    x, y, z = T_camera_world[:3, :3] @ mesh.vertices.T + T_camera_world[:3, 3:]
    ahead = np.maximum(z, near_m)
    u, v = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
    faces, first, size = _boxes(np.ascontiguousarray(mesh.faces.T), u, v, z, camera, near_m)
    corners, pixels = mesh.faces[faces].T, size[0] * size[1]
    # One row per pixel of each face's box.
    row = np.repeat(np.arange(len(faces)), pixels)
    within = np.arange(len(row)) - np.repeat(np.cumsum(pixels) - pixels, pixels)
    column, line = first[0, row] + within % size[0, row], first[1, row] + within // size[0, row]
    per_z, inside = _inverse_depth(u[corners], v[corners], 1.0 / z[corners], row, column, line)
    nearest = np.full(camera.height * camera.width, NOTHING)
    depth = (np.float32(1.0) / per_z[inside]).astype(np.float32)
    key = (depth.view(np.uint32).astype(np.uint64) << np.uint64(32)) | faces[row[inside]].astype(np.uint64)
    np.minimum.at(nearest, (line * camera.width + column)[inside], key)  # positive floats: same order as their bits
    shape, hit = (camera.height, camera.width), nearest != NOTHING
    depth_m = np.where(hit, (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32), np.float32(0.0))
    face = np.where(hit, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64), -1)
    return depth_m.reshape(shape), face.reshape(shape)


def _boxes(
    corners: NDArray[np.int32], u: Doubles, v: Doubles, z: Doubles, camera: Camera, near_m: float
) -> tuple[Rows, Rows, Rows]:
    """Return the faces [F'] that may be visible, the first pixel (column, line) of each box [2, F'] and its size [2,
    F']."""
    faces = np.flatnonzero((z > near_m)[corners].all(0))
    boxes: list[Rows] = []
    for values, pixels in ((u, camera.width), (v, camera.height)):
        # A box without a pixel centre ends before it begins.
        at = values[np.take(corners, faces, 1)]
        first, last = np.clip(np.ceil(at.min(0)), 0, pixels), np.clip(np.floor(at.max(0)), -1, pixels - 1)
        some = last >= first
        faces, first, last = faces[some], first[some].astype(np.intp), last[some].astype(np.intp)
        boxes = [box[:, some] for box in boxes] + [np.stack([first, last - first + 1])]
    return faces, *np.stack(boxes, 1)


def _inverse_depth(
    u: Doubles, v: Doubles, per_z: Doubles, row: Rows, column: Rows, line: Rows
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return 1/z at pixels, for faces (corners [3, F]), and whether each pixel is inside its face; row: the face of a
    pixel.

    1/z is affine over the image of a plane.
    """
    du, dv, dz = (c[1:] - c[:1] for c in (u, v, per_z))
    double_area = du[0] * dv[1] - du[1] * dv[0]
    per_area = np.divide(1.0, double_area, out=np.zeros_like(double_area), where=np.abs(double_area) > 1e-12)
    x, y = column - u[0, row], line - v[0, row]
    second = (x * dv[1, row] - y * du[1, row]) * per_area[row]
    third = (y * du[0, row] - x * dv[0, row]) * per_area[row]
    slack = 1e-9
    inside = (second >= -slack) & (third >= -slack) & (second + third <= 1.0 + slack) & (per_area[row] != 0.0)
    return per_z[0, row] + second * dz[0, row] + third * dz[1, row], inside
