"""Render the room: antialiased colour, exact depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, PITCH_M, furnish_rooms
from sigmasplat.plugins.sources.room.light import Light, light_room
from sigmasplat.plugins.sources.room.shapes import (
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

SUBPIXELS = np.array([[-0.375, -0.125, 0.375, 0.125], [-0.125, 0.375, 0.125, -0.375]], np.float32)
"""A rotated 2×2 grid: four different offsets in u and in v, [2, 4] pixels."""


@dataclass(frozen=True, eq=False)
class RoomScene:
    """Rooms in a row: all shapes, and the light of each room."""

    shapes: Sequence[Shape]
    lights: Sequence[Light]


@lru_cache(maxsize=4)
def build_scene(rooms: int, seed: int) -> RoomScene:
    """Build and light the rooms, about a second per room; the result is cached."""
    built = furnish_rooms(rooms, seed)
    neighbours = [built[max(k - 1, 0)] + built[k] if k else built[k] for k in range(rooms)]
    lights = [light_room(k, shapes) for k, shapes in enumerate(neighbours)]
    return RoomScene([shape for shapes in built for shape in shapes], lights)


def render_scene(
    scene: RoomScene, camera: Camera, T_world_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return colour [H, W, 3] in [0, 1] and exact depth [H, W] in metres along the optical axis.

    Depth and colour are those of the ray through the pixel centre. Where a neighbour shows another shape or face, the
    colour is the mean of four rays (antialiasing).
    """
    windows = image_windows(scene.shapes, se3.inverse(T_world_camera), camera)
    v, u = np.indices((camera.height, camera.width), np.float32).reshape(2, -1)
    color, depth_m, faces = _colors(scene, _rays(camera, T_world_camera, np.stack([u, v])), windows, camera.fx)
    edges = np.flatnonzero(_edges(faces.reshape(camera.height, camera.width)))
    pixels = np.stack([u[edges], v[edges]])[:, :, None] + SUBPIXELS[:, None, :]
    fine, _, _ = _colors(scene, _rays(camera, T_world_camera, pixels.reshape(2, -1)), windows, 2 * camera.fx)
    color[:, edges] = fine.reshape(3, -1, 4).mean(-1)
    size = (camera.height, camera.width)
    return color.T.reshape(*size, 3), depth_m.reshape(size)


def _rays(camera: Camera, T_world_camera: NDArray[np.float64], pixels: Floats) -> Rays:
    """Return rays through pixels [2, N]; a step of 1 along them is 1 m of depth."""
    R = T_world_camera[:3, :3].astype(np.float32)
    x, y = (pixels[0] - camera.cx) / camera.fx, (pixels[1] - camera.cy) / camera.fy
    directions = np.stack([R[k, 0] * x + R[k, 1] * y + R[k, 2] for k in range(3)]).astype(np.float32)
    return Rays(T_world_camera[:3, 3:].astype(np.float32), directions, pixels.astype(np.float32))


def _edges(faces: Indices) -> NDArray[np.bool_]:
    """Mark pixels with a neighbour (left, right, above or below) on another face."""
    marked = np.zeros(faces.shape, bool)
    across, down = faces[:, 1:] != faces[:, :-1], faces[1:] != faces[:-1]
    marked[:, 1:] |= across
    marked[:, :-1] |= across
    marked[1:] |= down
    marked[:-1] |= down
    return marked


@dataclass(frozen=True, eq=False)
class Hits:
    """Ray hits: parameter t [N] (inf for a miss), face number [N], normals [3, N], paint [3, N] in display values, and
    glow, mirror and gloss [N] of the material."""

    t: Floats
    faces: Indices
    normals: Floats
    paint: Floats
    glow: Floats
    mirror: Floats
    gloss: Floats


def _intersect(scene: RoomScene, rays: Rays, windows: Windows | None, focal_px: float) -> Hits:
    """Return the nearest hit of each ray, with the surface properties."""
    t, hit = cast_rays(scene.shapes, rays, windows)
    n = len(t)
    normals, paint, (glow, mirror, gloss) = np.zeros((3, n), np.float32), np.zeros((3, n), np.float32), np.zeros((3, n))
    faces = np.full(n, -1, np.intp)
    for k in np.unique(hit[hit >= 0]):
        at, shape = np.flatnonzero(hit == k), scene.shapes[k]
        directions, origins = rays.directions[:, at], rays.origins[:, at] if rays.origins.shape[1] > 1 else rays.origins
        normals[:, at], u, v = surface_at(shape, origins + directions * t[at])
        paint[:, at] = shape.material.texture(u, v, _pixel_m(directions, normals[:, at], t[at], focal_px))
        faces[at] = 32 * k + _face_number(shape, normals[:, at])
        glow[at], mirror[at], gloss[at] = shape.material.glow, shape.material.mirror, shape.material.gloss
    return Hits(t, faces, normals, paint, *(m.astype(np.float32) for m in (glow, mirror, gloss)))


def _pixel_m(directions: Floats, normals: Floats, t: Floats, focal_px: float) -> Floats:
    """Return a pixel's width on the surface, metres [N]: it grows with distance and slant."""
    length = np.sqrt(dot(directions, directions))
    cosine = -dot(normals, directions) / length
    return (t * length / np.float32(focal_px) / np.maximum(cosine, 0.15) ** 0.75).astype(np.float32)


def _face_number(shape: Shape, normals: Floats) -> Indices:
    """Number the smooth parts of one shape [N]: six faces of a box, caps and side of a drum, one part of a ball."""
    if shape.kind == "ball":
        return np.zeros(normals.shape[1], np.intp)
    n = np.rint(shape.to_local_axes(normals)).astype(np.intp) + 1
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
    linear = hits.paint**2 * (hits.glow + (1.0 - hits.glow) * falling) + highlight
    shiny = np.flatnonzero(hits.mirror)
    if len(shiny) and bounces:
        away = Rays(points[:, shiny] + np.float32(2e-3) * hits.normals[:, shiny], mirrored[:, shiny])
        reflected, _, _ = _colors(scene, away, None, 0.5 * focal_px, bounces - 1)
        share = hits.mirror[shiny]
        linear[:, shiny] = (1.0 - share) * linear[:, shiny] + share * reflected**2
    return np.sqrt(np.clip(linear, 0.0, 1.0)).astype(np.float32), hits.t, hits.faces


def _light(scene: RoomScene, points: Floats, hits: Hits, mirrored: Floats) -> tuple[Floats, Floats]:
    """Return the light on points [3, N] and the highlight towards the camera [N], room by room."""
    falling, highlight = np.zeros_like(points), np.zeros(points.shape[1], np.float32)
    in_front_x = (
        points[0] + np.float32(0.05) * hits.normals[0]
    )  # the far face of a shared wall belongs to the next room
    room = np.clip(np.floor((in_front_x + HALF_X_M) / PITCH_M), 0, len(scene.lights) - 1)
    for k in np.unique(room):
        at, light = np.flatnonzero(room == k), scene.lights[int(k)]
        falling[:, at], shares = light.at(points[:, at], hits.normals[:, at])
        glossy = np.flatnonzero(hits.gloss[at])
        for lamp, share in zip((light.lamp, light.window), shares[:, glossy], strict=True):
            towards = normalised(lamp - points[:, at[glossy]])
            lobe = np.maximum(dot(towards, mirrored[:, at[glossy]]), 0.0) ** 24
            highlight[at[glossy]] += hits.gloss[at[glossy]] * share * lobe
    return falling, highlight
