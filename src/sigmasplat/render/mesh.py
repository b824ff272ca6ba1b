"""Render a mesh from a camera: the depth and the face at each pixel."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh
from sigmasplat.native import _core

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]


def mesh_depth(
    mesh: Mesh, camera: Camera, T_camera_world: Doubles, near_m: float = 0.02
) -> tuple[NDArray[np.float32], Indices]:
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
