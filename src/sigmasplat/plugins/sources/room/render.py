"""Light the room, computed once on a lattice, and render it: antialiased colour, exact depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sigmasplat.api import Camera, Matrix, se3
from sigmasplat.plugins.sources.room.capture import Image
from sigmasplat.plugins.sources.room.corridor import furnish_corridor, furnish_wall
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, HALF_Y_M, HEIGHT_M, PITCH_M, WALL_M, furnish_rooms
from sigmasplat.plugins.sources.room.shapes import (
    CUBE,
    Indices,
    Rays,
    Shape,
    Windows,
    cast_rays,
    dot,
    image_windows,
    normalised,
    surface_at,
)
from sigmasplat.plugins.sources.room.textures import Floats

CELL_M, AMBIENT_REACH_M = 0.14, 0.7
"""Distance of the lattice's points, and the largest one at which a surface reduces the ambient light."""
LAMP_M, WINDOW_M = (0.0, 0.0, HEIGHT_M - 0.16), (-0.85, -HALF_Y_M + 0.1, 1.6)
LAMP_COLOR = np.array([[1.0], [0.93], [0.82]], np.float32) * np.float32(1.35)
WINDOW_COLOR = np.array([[0.86], [0.95], [1.08]], np.float32) * np.float32(0.75)
AMBIENT_COLOR = np.array([[0.46], [0.47], [0.48]], np.float32)
BRIGHT = 2.6
"""Share of the surroundings' light in an evenly lit corridor: no place of a room has more than 1."""


@dataclass(frozen=True, eq=False)
class Light:
    """Visible shares in [0, 1] of surroundings, lamp and window on a lattice over one room: shares [3, X, Y, Z]."""

    room_x_m: float
    side: float
    shares: Floats

    def at(self, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Return the light on surface points, RGB [3, N], and the visible shares of lamp and window [2, N]."""
        start = np.array([[self.room_x_m - HALF_X_M - WALL_M], [-HALF_Y_M], [0.0]], np.float32)
        where = (points + np.float32(0.6 * CELL_M) * normals - start) / np.float32(CELL_M) - 0.5
        ambient, lamp, window = (ndimage.map_coordinates(s, where, order=1, mode="nearest") for s in self.shares)
        total = AMBIENT_COLOR * (0.35 + 0.65 * ambient)
        total = total + LAMP_COLOR * (lamp * _lamp_light(self.place(LAMP_M) - points, normals, 1.6))
        total = total + WINDOW_COLOR * (window * _lamp_light(self.place(WINDOW_M) - points, normals, 1.4))
        return total.astype(np.float32), np.stack([lamp, window])

    def place(self, at: tuple[float, float, float]) -> Floats:
        """Return a place of the first room in this one [3, 1], metres."""
        return np.array([[self.side * at[0] + self.room_x_m], [at[1]], [at[2]]], np.float32)


def _lamp_light(towards: Floats, normals: Floats, reach_m: float) -> Floats:
    """Return the light of a lamp at offset `towards` [3, N]: softened cosine, falling with distance."""
    distance2 = dot(towards, towards)
    cosine = dot(towards, normals) / np.sqrt(distance2 + 1e-6)
    wrapped = np.maximum((cosine + 0.15) / 1.15, 0.0)
    return np.asarray(wrapped * (reach_m * reach_m * 1.6 / (reach_m * reach_m + distance2)), np.float32)


def even_light(number: int) -> Light:
    """Return the same light everywhere in one section of a corridor: shades would show where the camera is."""
    shares = np.zeros((3, 2, 2, 2), np.float32)
    shares[0] = BRIGHT
    return Light(number * PITCH_M, 1.0, shares)


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
    solid = np.any([(np.abs(shape.local(points)) < shape.half[:, None]).all(0) for shape in opaque], 0).reshape(counts)
    # Points inside solids get the light of the nearest free point, so that surfaces are not too dark.
    nearest = ndimage.distance_transform_edt(solid, return_distances=False, return_indices=True)
    return Light(light.room_x_m, side, np.stack(shares).reshape(3, *counts)[:, *nearest])


def _ambient_share(points: Floats, shapes: Sequence[Shape]) -> Floats:
    reach = np.float32(AMBIENT_REACH_M / np.sqrt(3.0))
    free = [_free(points, np.broadcast_to(np.array([s], np.float32).T * reach, points.shape), shapes) for s in CUBE]
    return np.asarray(np.mean(free, 0, dtype=np.float32))


def _lamp_share(points: Floats, shapes: Sequence[Shape], light: Light, which: int) -> Floats:
    """Return the share of sample points of the lamp (0) or window (1) visible from each lattice point."""
    at, spread = ((LAMP_M, (0.45, 0.45, 0.0)), (WINDOW_M, (0.6, 0.0, 0.42)))[which]
    signs = [(x, y, z) for x, y, z in CUBE if y == z or which == 0]
    targets = [light.place(at) + np.array([[s[k] * spread[k]] for k in range(3)], np.float32) for s in signs[:4]]
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


SUBPIXELS = np.array([[-0.375, -0.125, 0.375, 0.125], [-0.125, 0.375, 0.125, -0.375]], np.float32)
"""A rotated 2×2 grid: four different offsets in u and in v, [2, 4] pixels."""


@dataclass(frozen=True, eq=False)
class RoomScene:
    """Rooms in a row: all shapes, and the light of each room."""

    shapes: Sequence[Shape]
    lights: Sequence[Light]


def furnished(rooms: int, seed: int, corridor: bool = False, wall: int = 0) -> list[list[Shape]]:
    """Build the rooms, or as many sections of a corridor or a wall, without light; return the shapes of each."""
    if wall:
        return furnish_wall(rooms, seed, wall)
    return furnish_corridor(rooms, seed) if corridor else furnish_rooms(rooms, seed)


@lru_cache(maxsize=4)
def build_scene(rooms: int, seed: int, corridor: bool = False, wall: int = 0) -> RoomScene:
    """Build and light the rooms, about a second per room, or as many sections of a corridor or a wall; the result is
    cached."""
    built = furnished(rooms, seed, corridor, wall)
    even, before = corridor or wall, [[], *built]
    lights = [even_light(k) if even else light_room(k, before[k] + built[k]) for k in range(rooms)]
    return RoomScene([shape for shapes in built for shape in shapes], lights)


def render_scene(scene: RoomScene, camera: Camera, T_world_camera: Matrix) -> tuple[Image, Image]:
    """Return colour [H, W, 3] in [0, 1] and exact depth [H, W] in metres along the optical axis.

    Depth and colour are those of the ray through the pixel centre. Where a neighbour shows another shape or face, the
    colour is the mean of four rays (antialiasing). T_world_camera [4, 4], or [H, 4, 4]: a pose for each row.
    """
    row_by_row = T_world_camera.ndim == 3  # no windows then: they are those of one pose
    windows = None if row_by_row else image_windows(scene.shapes, se3.inverse(T_world_camera), camera)
    v, u = np.indices((camera.height, camera.width), np.float32).reshape(2, -1)
    color, depth_m, faces = _colors(scene, _rays(camera, T_world_camera, np.stack([u, v])), windows, camera.fx)
    edges = np.flatnonzero(_edges(faces.reshape(camera.height, camera.width)))
    pixels = np.stack([u[edges], v[edges]])[:, :, None] + SUBPIXELS[:, None, :]
    fine, _, _ = _colors(scene, _rays(camera, T_world_camera, pixels.reshape(2, -1)), windows, 2 * camera.fx)
    color[:, edges] = fine.reshape(3, -1, 4).mean(-1)
    return color.T.reshape(camera.height, camera.width, 3), depth_m.reshape(camera.height, camera.width)


def _rays(camera: Camera, T_world_camera: NDArray[np.float64], pixels: Floats) -> Rays:
    """Return rays through pixels [2, N]; a step of 1 along them is 1 m of depth. The pose is one, or one per row."""
    R, origins = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3:]
    if T_world_camera.ndim == 3:
        T = np.moveaxis(T_world_camera[np.rint(pixels[1]).astype(int)], 0, -1)
        R, origins = T[:3, :3].astype(np.float32), T[:3, 3]
    x, y = (pixels[0] - camera.cx) / camera.fx, (pixels[1] - camera.cy) / camera.fy
    directions = np.stack([R[k, 0] * x + R[k, 1] * y + R[k, 2] for k in range(3)]).astype(np.float32)
    return Rays(origins.astype(np.float32), directions, pixels.astype(np.float32))


def _edges(faces: Indices) -> NDArray[np.bool_]:
    around = ndimage.generate_binary_structure(2, 1)
    return np.asarray(
        ndimage.maximum_filter(faces, footprint=around) != ndimage.minimum_filter(faces, footprint=around)
    )


@dataclass(frozen=True, eq=False)
class Hits:
    """Ray hits: parameter t [N] (inf for a miss), face number [N], normals [3, N], paint [3, N] in display values;
    material [3, N]: glow, mirror and gloss."""

    t: Floats
    faces: Indices
    normals: Floats
    paint: Floats
    material: Floats


def _intersect(scene: RoomScene, rays: Rays, windows: Windows | None, focal_px: float) -> Hits:
    t, hit = cast_rays(scene.shapes, rays, windows)
    normals, paint, material = np.zeros((3, 3, len(t)), np.float32)
    faces = np.full(len(t), -1, np.intp)
    for k in np.unique(hit[hit >= 0]):
        at, shape = np.flatnonzero(hit == k), scene.shapes[k]
        made = shape.material
        directions, origins = rays.directions[:, at], rays.origins[:, at] if rays.origins.shape[1] > 1 else rays.origins
        normals[:, at], u, v = surface_at(shape, origins + directions * t[at])
        paint[:, at] = made.texture(u, v, _pixel_m(directions, normals[:, at], t[at], focal_px))
        faces[at] = 32 * k + _face_number(shape, normals[:, at])
        material[:, at] = np.array([[made.glow], [made.mirror], [made.gloss]])
    return Hits(t, faces, normals, paint, material)


def _pixel_m(directions: Floats, normals: Floats, t: Floats, focal_px: float) -> Floats:
    """Return a pixel's width on the surface, metres [N]: it grows with distance and slant."""
    length = np.sqrt(dot(directions, directions))
    cosine = -dot(normals, directions) / length
    return (t * length / np.float32(focal_px) / np.maximum(cosine, 0.15) ** 0.75).astype(np.float32)


def _face_number(shape: Shape, normals: Floats) -> Indices:
    """Number the smooth parts of one shape [N]: six faces of a box, caps and side of a drum, one part of a ball."""
    if shape.kind == "ball":
        return np.zeros(normals.shape[1], np.intp)
    n = np.rint(shape.to_room_axes(normals, -1)).astype(np.intp) + 1
    return np.asarray(n[2] if shape.kind == "drum" else n[0] + 3 * n[1] + 9 * n[2])


def _colors(
    scene: RoomScene, rays: Rays, windows: Windows | None, focal_px: float, bounces: int = 1
) -> tuple[Floats, Floats, Indices]:
    """Return the colour of each ray [3, N], the parameter of its hit [N], and its face number [N]."""
    hits = _intersect(scene, rays, windows, focal_px)
    points = rays.origins + rays.directions * np.where(np.isfinite(hits.t), hits.t, 0.0)
    mirrored = rays.directions - 2.0 * dot(hits.normals, rays.directions) * hits.normals
    falling, highlight = _light(scene, points, hits, normalised(mirrored))
    # Display values are about the square root of light, so paint is squared first and the sum is rooted.
    glow, mirror, _ = hits.material
    linear = hits.paint**2 * (glow + (1.0 - glow) * falling) + highlight
    shiny = np.flatnonzero(mirror)
    if len(shiny) and bounces:
        away = Rays(points[:, shiny] + np.float32(2e-3) * hits.normals[:, shiny], mirrored[:, shiny])
        reflected, _, _ = _colors(scene, away, None, 0.5 * focal_px, bounces - 1)
        linear[:, shiny] = (1.0 - mirror[shiny]) * linear[:, shiny] + mirror[shiny] * reflected**2
    return np.sqrt(np.clip(linear, 0.0, 1.0)).astype(np.float32), hits.t, hits.faces


def _light(scene: RoomScene, points: Floats, hits: Hits, mirrored: Floats) -> tuple[Floats, Floats]:
    """Return the light on points [3, N] and the highlight towards the camera [N], room by room."""
    falling, highlight = np.zeros_like(points), np.zeros(points.shape[1], np.float32)
    in_front_x = points[0] + np.float32(0.05) * hits.normals[0]  # a shared wall's far face belongs to the next room
    room = np.clip(np.floor((in_front_x + HALF_X_M) / PITCH_M), 0, len(scene.lights) - 1)
    for k in np.unique(room):
        at, light = np.flatnonzero(room == k), scene.lights[int(k)]
        falling[:, at], shares = light.at(points[:, at], hits.normals[:, at])
        glossy = np.flatnonzero(hits.material[2, at])
        for lamp, share in zip((LAMP_M, WINDOW_M), shares[:, glossy], strict=True):
            towards = normalised(light.place(lamp) - points[:, at[glossy]])
            lobe = np.maximum(dot(towards, mirrored[:, at[glossy]]), 0.0) ** 24
            highlight[at[glossy]] += hits.material[2, at[glossy]] * share * lobe
    return falling, highlight
