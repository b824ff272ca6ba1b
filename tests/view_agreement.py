"""Oracle shared by tests of sources: do two views of a sequence see the same surfaces?"""

import numpy as np

from sigmasplat.data import se3
from sigmasplat.plugins.sources import Source


def agreement(source: Source, i: int, j: int):
    """Return how far frame i's points lie behind the surface frame j sees there, metres [N], and which are seen."""
    truth = source.truth().T_world_camera
    a, b, camera = source.frame(i), source.frame(j), source.camera
    points = (camera.rays() * a.depth_m[..., None])[a.depth_m > 0].astype(float)
    T = se3.inverse(truth[j]) @ truth[i]
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    u, v = np.rint(camera.fx * x / z + camera.cx).astype(int), np.rint(camera.fy * y / z + camera.cy).astype(int)
    inside = (z > 0.05) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    seen_m = b.depth_m[v[inside], u[inside]]
    behind_m = (z[inside] - seen_m)[seen_m > 0]
    return behind_m, np.abs(behind_m) < 0.05
