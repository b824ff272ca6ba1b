"""Move depth from the camera that measured it into the colour camera's pixels."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.model.camera import Camera

OVERLAP = 1.1
"""Footprints are drawn this much larger than they are, so that rotation leaves no cracks between neighbours."""
MAX_HALF_FOOTPRINT_PX = 32.0
"""Half of the largest footprint: a reading at the camera's own centre must not fill the image."""
CHUNK_READINGS = 8192
"""Readings that are moved together: few enough that all of their numbers stay in the processor's cache."""

Floats = NDArray[np.float64]


class DepthRegistration:
    """Draw each depth pixel as the square that it covers in the colour image; where several fall, the nearest counts.

    So a surface that the colour camera cannot see does not shine through one in front of it, and a coarser depth image
    fills a finer colour image. T_color_depth [4, 4] takes points of the depth camera to the colour camera, metres.
    """

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: Floats) -> None:
        self.depth_camera = depth_camera
        self.color_camera = color_camera
        self.T_color_depth = T_color_depth

    @cached_property
    def _rays(self) -> Floats:
        """Return each depth pixel's ray, turned into the colour camera's axes [3, H·W]."""
        rays = self.depth_camera.rays().reshape(-1, 3).astype(np.float64) @ self.T_color_depth[:3, :3].T
        return np.ascontiguousarray(rays.T)

    def __call__(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth [H, W] of the colour camera from that [h, w] of the depth camera, m along the axis; 0 = none."""
        c, z_depth = self.color_camera, depth_m.reshape(-1)
        nearest = np.full(c.height * c.width, np.inf)
        for first in range(0, len(z_depth), CHUNK_READINGS):
            seen = first + np.flatnonzero(z_depth[first : first + CHUNK_READINGS] > 0)
            draw_footprints(nearest, c.width, *self._footprints(seen, z_depth[seen]))
        nearest[np.isinf(nearest)] = 0.0
        return nearest.astype(np.float32).reshape(c.height, c.width)

    def _footprints(self, seen: NDArray[np.int64], z_depth: NDArray[np.float32]) -> tuple[Floats, Floats, Floats]:
        """Return first and last column and row [2, N] that depth pixels `seen` cover, and their depth [N] m there."""
        c, d, t = self.color_camera, self.depth_camera, self.T_color_depth[:3, 3]
        x, y, z = (self._rays[axis].take(seen) * z_depth + t[axis] for axis in range(3))
        if not (front := z > 1e-6).all():
            x, y, z, z_depth = x[front], y[front], z[front], z_depth[front]
        size = OVERLAP * z_depth / z
        columns = _span(c.fx * x / z + c.cx, 0.5 * size * c.fx / d.fx, c.width)
        rows = _span(c.fy * y / z + c.cy, 0.5 * size * c.fy / d.fy, c.height)
        return columns, rows, z


def draw_footprints(nearest: Floats, width: int, columns: Floats, rows: Floats, z: Floats) -> None:
    """Put depths z [N] into pixels first … last [2, N] of an image `nearest` [rows · width]; the least one stays."""
    most = [int(np.fmax.reduce(ends[1] - ends[0], initial=-1.0)) for ends in (columns, rows)]
    for dy in range(most[1] + 1):
        for dx in range(most[0] + 1):
            column, row = columns[0] + dx, rows[0] + dy
            covered = np.flatnonzero((column <= columns[1]) & (row <= rows[1]))
            pixels = (row * width + column).take(covered).astype(np.int64)
            np.minimum.at(nearest, pixels, z.take(covered))


def _span(centre: Floats, half: Floats, count: int) -> Floats:
    """Return the first and the last of `count` pixels whose centre lies within centre ± half, [2, N]; last < first
    where there is none."""
    bounded = np.clip(half, 0.0, MAX_HALF_FOOTPRINT_PX)
    return np.stack([np.maximum(np.ceil(centre - bounded), 0.0), np.minimum(np.floor(centre + bounded), count - 1.0)])
