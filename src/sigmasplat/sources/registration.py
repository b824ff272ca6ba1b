"""Move depth from the camera that measured it into the colour camera's pixels."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.model.camera import Camera

OVERLAP = 1.1
"""Footprints are drawn this much larger than they are, so that rotation leaves no cracks between neighbours."""


class Registration:
    """Draw each depth pixel as the square that it covers in the colour image; where several fall, the nearest counts.

    So a surface that the colour camera cannot see does not shine through one in front of it, and a coarser depth image
    fills a finer colour image. T_color_depth [4, 4] takes points of the depth camera to the colour camera, metres.
    """

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: NDArray[np.float64]) -> None:
        self.depth_camera = depth_camera
        self.color_camera = color_camera
        self.T_color_depth = T_color_depth

    @cached_property
    def _rays(self) -> NDArray[np.float64]:
        """Return each depth pixel's ray, turned into the colour camera's axes [H·W, 3]."""
        return self.depth_camera.rays().reshape(-1, 3).astype(np.float64) @ self.T_color_depth[:3, :3].T

    def __call__(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth [H, W] of the colour camera from that [h, w] of the depth camera, m along the axis; 0 = none."""
        c, z_depth = self.color_camera, depth_m.reshape(-1)
        seen = np.flatnonzero(z_depth > 0)
        points = self._rays[seen] * z_depth[seen, None] + self.T_color_depth[:3, 3]
        front = points[:, 2] > 1e-6
        x, y, z = points[front].T
        size = OVERLAP * z_depth[seen][front] / z
        u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
        half_u, half_v = 0.5 * size * c.fx / self.depth_camera.fx, 0.5 * size * c.fy / self.depth_camera.fy
        return self._drawn(_span(u, half_u), _span(v, half_v), z)

    def _drawn(
        self, columns: NDArray[np.int64], rows: NDArray[np.int64], z: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Fill pixels first … last [2, N] of each splat with its depth, the nearest winning."""
        c = self.color_camera
        nearest = np.full(c.height * c.width, np.inf)
        largest = [int((ends[1] - ends[0]).max(initial=-1)) for ends in (columns, rows)]
        for dy in range(largest[1] + 1):
            for dx in range(largest[0] + 1):
                column, row = columns[0] + dx, rows[0] + dy
                inside = (column <= columns[1]) & (row <= rows[1]) & (column >= 0) & (column < c.width)
                inside &= (row >= 0) & (row < c.height)
                np.minimum.at(nearest, row[inside] * c.width + column[inside], z[inside])
        return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32).reshape(c.height, c.width)


def _span(centre: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the first and the last pixel whose centre lies within centre ± half, [2, N]; last < first where none."""
    bounded = np.clip(half, 0.0, 32.0)  # a reading at the camera's own centre must not fill the image
    return np.stack([np.ceil(centre - bounded), np.floor(centre + bounded)]).clip(-1e6, 1e6).astype(np.int64)
