"""Register depth: move it from the depth camera to the colour camera's pixels."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera

OVERLAP = 1.1
"""Footprints are enlarged by this factor, so that rotation leaves no gaps between neighbours."""
MAX_HALF_FOOTPRINT_PX = 32.0
"""Half of the largest footprint: a reading near the camera centre must not fill the image."""
CHUNK_READINGS = 8192
"""Readings processed together: few enough for the processor's cache."""

Floats = NDArray[np.float64]


class DepthRegistration:
    """Draw each depth pixel as the square that it covers in the colour image; where squares overlap, the nearest wins.

    A surface hidden from the colour camera therefore does not show through one in front of it, and a small depth image
    fills a larger colour image. T_color_depth [4, 4] transforms depth camera points to the colour camera, metres.
    """

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: Floats) -> None:
        self.depth_camera = depth_camera
        self.color_camera = color_camera
        self.T_color_depth = T_color_depth

    @cached_property
    def _rays(self) -> Floats:
        """Return the ray of each depth pixel in the colour camera's axes [3, H·W]."""
        rays = self.depth_camera.rays().reshape(-1, 3).astype(np.float64) @ self.T_color_depth[:3, :3].T
        return np.ascontiguousarray(rays.T)

    def __call__(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth [H, W] for the colour camera from depth [h, w] of the depth camera, m; 0 = no reading."""
        c, z_depth = self.color_camera, depth_m.reshape(-1)
        nearest = np.full(c.height * c.width, np.inf)
        for first in range(0, len(z_depth), CHUNK_READINGS):
            valid = first + np.flatnonzero(z_depth[first : first + CHUNK_READINGS] > 0)
            draw_footprints(nearest, c.width, *self._footprints(valid, z_depth[valid]))
        nearest[np.isinf(nearest)] = 0.0
        return nearest.astype(np.float32).reshape(c.height, c.width)

    def _footprints(self, valid: NDArray[np.int64], z_depth: NDArray[np.float32]) -> tuple[Floats, Floats, Floats]:
        """Return first and last column and row [2, N] covered by the depth pixels `valid`, and their depth [N] m."""
        c, d, t = self.color_camera, self.depth_camera, self.T_color_depth[:3, 3]
        x, y, z = (self._rays[axis].take(valid) * z_depth + t[axis] for axis in range(3))
        if not (front := z > 1e-6).all():
            x, y, z, z_depth = x[front], y[front], z[front], z_depth[front]
        size = OVERLAP * z_depth / z
        columns = _span(c.fx * x / z + c.cx, 0.5 * size * c.fx / d.fx, c.width)
        rows = _span(c.fy * y / z + c.cy, 0.5 * size * c.fy / d.fy, c.height)
        return columns, rows, z


def draw_footprints(nearest: Floats, width: int, columns: Floats, rows: Floats, z: Floats) -> None:
    """Write depths z [N] to pixels first … last [2, N] of an image `nearest` [rows · width]; the smallest wins."""
    most = [int(np.fmax.reduce(ends[1] - ends[0], initial=-1.0)) for ends in (columns, rows)]
    for dy in range(most[1] + 1):
        for dx in range(most[0] + 1):
            column, row = columns[0] + dx, rows[0] + dy
            covered = np.flatnonzero((column <= columns[1]) & (row <= rows[1]))
            pixels = (row * width + column).take(covered).astype(np.int64)
            np.minimum.at(nearest, pixels, z.take(covered))


def _span(centre: Floats, half: Floats, count: int) -> Floats:
    """Return first and last pixel of `count` whose centre is within centre ± half, [2, N]; last < first if none."""
    bounded = np.clip(half, 0.0, MAX_HALF_FOOTPRINT_PX)
    return np.stack([np.maximum(np.ceil(centre - bounded), 0.0), np.minimum(np.floor(centre + bounded), count - 1.0)])
