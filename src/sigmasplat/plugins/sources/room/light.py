"""Light the room: visible share of lamp, window and surroundings, computed once on a lattice."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from sigmasplat.plugins.sources.room.furnish import HALF_X_M, HALF_Y_M, HEIGHT_M, PITCH_M, WALL_M
from sigmasplat.plugins.sources.room.shapes import Shape, dot
from sigmasplat.plugins.sources.room.textures import Floats

CELL_M = 0.14
AMBIENT_REACH_M = 0.7
"""Largest distance at which a surface reduces the ambient light."""

LAMP_M = (0.0, 0.0, HEIGHT_M - 0.16)
WINDOW_M = (-0.85, -HALF_Y_M + 0.1, 1.6)
LAMP_COLOR = np.array([[1.0], [0.93], [0.82]], np.float32) * np.float32(1.35)
WINDOW_COLOR = np.array([[0.86], [0.95], [1.08]], np.float32) * np.float32(0.75)
AMBIENT_COLOR = np.array([[0.46], [0.47], [0.48]], np.float32)


@dataclass(frozen=True, eq=False)
class Light:
    """Visible shares in [0, 1] of surroundings, lamp and window on a lattice over one room: shares [3, X, Y, Z]."""

    room_x_m: float
    side: float
    shares: Floats

    def at(self, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Return the light on surface points, RGB [3, N], and the visible shares of lamp and window [2, N]."""
        ambient, lamp, window = self._shares_at(points + np.float32(0.6 * CELL_M) * normals)
        total = AMBIENT_COLOR * (0.35 + 0.65 * ambient)
        total = total + LAMP_COLOR * (lamp * _lamp_light(self.lamp - points, normals, 1.6))
        total = total + WINDOW_COLOR * (window * _lamp_light(self.window - points, normals, 1.4))
        return total.astype(np.float32), np.stack([lamp, window])

    @property
    def lamp(self) -> Floats:
        """Return the position of the lamp [3, 1], metres."""
        return self._place(LAMP_M)

    @property
    def window(self) -> Floats:
        """Return the centre of the window [3, 1], metres."""
        return self._place(WINDOW_M)

    def _place(self, at: tuple[float, float, float]) -> Floats:
        return np.array([[self.side * at[0] + self.room_x_m], [at[1]], [at[2]]], np.float32)

    def _shares_at(self, points: Floats) -> Floats:
        start = np.array([[self.room_x_m - HALF_X_M - WALL_M], [-HALF_Y_M], [0.0]], np.float32)
        where = (points - start) / np.float32(CELL_M) - 0.5
        seen: Floats = np.stack([map_coordinates(s, where, order=1, mode="nearest") for s in self.shares])
        return seen


def _lamp_light(towards: Floats, normals: Floats, reach_m: float) -> Floats:
    """Return the light of a lamp at offset `towards` [3, N]: softened cosine, falling with distance."""
    distance2 = dot(towards, towards)
    cosine = dot(towards, normals) / np.sqrt(distance2 + 1e-6)
    wrapped = np.maximum((cosine + 0.15) / 1.15, 0.0)
    return np.asarray(wrapped * (reach_m * reach_m * 1.6 / (reach_m * reach_m + distance2)), np.float32)


def light_room(number: int, shapes: Sequence[Shape]) -> Light:
    """Compute the light in one room from its shapes."""
    side = -1.0 if number % 2 else 1.0
    light = Light(number * PITCH_M, side, np.zeros((3, 1, 1, 1), np.float32))
    counts = [int(np.ceil(span / CELL_M)) for span in (PITCH_M + WALL_M, 2 * HALF_Y_M, HEIGHT_M)]
    lattice = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float32) + 0.5 for n in counts], indexing="ij"))
    start = np.array([light.room_x_m - HALF_X_M - WALL_M, -HALF_Y_M, 0.0], np.float32)
    points = (lattice * np.float32(CELL_M)).reshape(3, -1) + start[:, None]
    opaque = [s for s in shapes if not s.material.glow and s.half.min() > 0.015 and s.half.max() > 0.1]
    shares = [_ambient_share(points, opaque), *(_lamp_share(points, opaque, light, which) for which in (0, 1))]
    solid = _inside_any(points, opaque).reshape(counts)
    return Light(light.room_x_m, side, np.stack([_filled(s.reshape(counts), solid) for s in shares]))


def _ambient_share(points: Floats, shapes: Sequence[Shape]) -> Floats:
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    reach = np.float32(AMBIENT_REACH_M / np.sqrt(3.0))
    free = [_free(points, np.broadcast_to(np.array([s], np.float32).T * reach, points.shape), shapes) for s in signs]
    return np.asarray(np.mean(free, 0, dtype=np.float32))


def _lamp_share(points: Floats, shapes: Sequence[Shape], light: Light, which: int) -> Floats:
    """Return the share of sample points of the lamp (0) or window (1) visible from each lattice point."""
    center, spread = ((light.lamp, (0.45, 0.45, 0.0)), (light.window, (0.6, 0.0, 0.42)))[which]
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1) if y == z or which == 0]
    targets = [center + np.array([[s[k] * spread[k]] for k in range(3)], np.float32) for s in signs[:4]]
    return np.asarray(np.mean([_free(points, t - points, shapes) for t in targets], 0, dtype=np.float32))


def _free(points: Floats, segments: Floats, shapes: Sequence[Shape]) -> Floats:
    """Return 1 if no shape blocks the segment from a point, else 0, [N]."""
    free = np.ones(points.shape[1], np.float32)
    low, high = np.minimum(points, points + segments), np.maximum(points, points + segments)
    for shape in shapes:
        corners = shape.corners().astype(np.float32)
        near = ((high > corners.min(0)[:, None]) & (low < corners.max(0)[:, None])).all(0)
        among = np.flatnonzero(near & (free > 0))
        free[among[shape.first_hit(points[:, among], segments[:, among]) <= 1.0]] = 0.0
    return free


def _inside_any(points: Floats, shapes: Sequence[Shape]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    inside = np.zeros(points.shape[1], bool)
    for shape in shapes:
        inside |= (np.abs(shape.local(points)) < shape.half[:, None]).all(0)
    return inside


def _filled(shares: Floats, solid: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Floats:
    """Give points inside solids the light of the nearest free point, so that surfaces are not too dark."""
    if solid.all() or not solid.any():
        return shares
    nearest = distance_transform_edt(solid, return_distances=False, return_indices=True)
    grown: Floats = shares[tuple(nearest)]
    return grown
