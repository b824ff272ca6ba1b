"""A ball that moves through the room by itself: slowly, fast, not at all, and on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.plugins.sources.room.shapes import Rays, Shape
from sigmasplat.plugins.sources.room.textures import Material, checks
from sigmasplat.types import Matrix

CENTER_M, REACH_M = np.array([0.0, 0.0, 1.28]), np.array([0.3, 0.12, 0.08])
"""Centre of the ball's path, in space that the room leaves free, and how far it goes from there along x, y, z."""
TURNS = 2.0
PACE = ((0.0, 0.3, 1.0), (0.3, 0.5, 3.5), (0.5, 0.65, 0.0), (0.65, 0.8, 3.5), (0.8, 1.0, 1.0))
"""Phases of the motion: from and to which share of the sequence, and the relative speed. It stands still in one."""
LEAST_M, MOST_M = 0.02, 0.4
"""Smallest and largest radius."""
CELL_PX, SAMPLES = 8, 60
"""The share of the image is measured at every eighth pixel of this many frames."""


@dataclass(frozen=True, eq=False)
class Mover:
    """The ball: its radius, its centre in each frame [F, 3] m, in the room's frame, and how far it turned [F] rad."""

    radius_m: float
    centers_m: Matrix
    yaw_rad: Matrix

    def shape(self, i: int) -> Shape:
        """Return the ball in frame i."""
        paint = Material(checks((0.82, 0.28, 0.16), (0.93, 0.86, 0.62), 0.06, seed=5), gloss=0.15)
        half = np.full(3, self.radius_m, np.float32)
        return Shape("ball", self.centers_m[i].astype(np.float32), half, float(self.yaw_rad[i]), paint)

    def moves(self, i: int) -> bool:
        """Return whether the ball is at another place than in the frame before; in the first frame, in the next."""
        last = len(self.centers_m) - 1
        a, b = (max(i - 1, 0), i) if i else (0, min(1, last))
        return bool(np.abs(self.centers_m[b] - self.centers_m[a]).max() > 1e-9)


def mover(T_world_camera: Matrix, camera: Camera, share: float) -> Mover:
    """Return a ball that covers this share of the image on average, 0 to 1; its path does not depend on the camera."""
    at = np.arange(len(T_world_camera)) / max(len(T_world_camera) - 1, 1)
    turn = 2 * np.pi * TURNS * _done(at)
    centers_m = CENTER_M + REACH_M * np.stack([np.cos(-turn), np.sin(-turn), np.sin(1.5 * turn)], -1)
    low, high = LEAST_M, MOST_M
    for _ in range(20):
        radius_m = (low + high) / 2
        low, high = (low, radius_m) if _share(T_world_camera, camera, centers_m, radius_m) > share else (radius_m, high)
    return Mover(high, centers_m, turn)


def _done(at: Matrix) -> NDArray[np.float64]:
    """Return the share of the path that is behind the ball at a share of the sequence."""
    ends = np.cumsum([0.0, *((until - since) * pace for since, until, pace in PACE)])
    return np.asarray(np.interp(at, [0.0, *(until for _, until, _ in PACE)], ends / ends[-1]))


def _share(T_world_camera: Matrix, camera: Camera, centers_m: Matrix, radius_m: float) -> float:
    """Return the mean share of the image that the ball covers."""
    some = np.linspace(0, len(centers_m) - 1, min(SAMPLES, len(centers_m))).round().astype(int)
    rays = camera.rays()[::CELL_PX, ::CELL_PX].reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    covered = []
    for T, center in zip(T_world_camera[some], centers_m[some], strict=True):
        away = T[:3, :3].T @ (center - T[:3, 3])
        along = rays @ away
        covered.append(np.mean((along > 0) & (away @ away - along**2 < radius_m**2)))
    return float(np.mean(covered))


def mask_of(ball: Shape, camera: Camera, T_world_camera: Matrix, depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels [H, W] that show the ball in an image with exact depth [H, W] m."""
    rays = np.asarray(camera.rays(), np.float32).reshape(-1, 3).T
    R = T_world_camera[:3, :3].astype(np.float32)
    cast = Rays(T_world_camera[:3, 3:].astype(np.float32), R @ rays)
    hit = ball.first_hit(cast.origins, cast.directions).reshape(depth_m.shape)
    return np.isfinite(hit) & (hit <= depth_m + 1e-4)
