"""Build the rooms and their furniture, and a ball that moves through the room by itself.

A room spans x ∈ [−2.5, 2.5], y ∈ [−2, 2], z ∈ [0, 2.6] m about its centre. Further rooms follow along x, PITCH_M apart,
with doorways at y = 0. The space above 1.1 m within 1.2 m of the centre line is free for the camera.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Camera, Matrix
from sigmasplat.plugins.sources.room.shapes import Kind, Shape
from sigmasplat.plugins.sources.room.textures import (
    Color,
    Material,
    Texture,
    books,
    brick,
    checks,
    leaves,
    painting,
    plain,
    rug,
    sky,
    two_tone,
    wallpaper,
    weave,
    wood,
)

Triple = tuple[float, float, float]
HALF_X_M, HALF_Y_M, HEIGHT_M, WALL_M = 2.5, 2.0, 2.6, 0.15
PITCH_M = 2 * HALF_X_M + WALL_M
DOOR_HALF_M, DOOR_HEIGHT_M = 0.55, 2.15
LEGS = ((-1, -1), (-1, 1), (1, -1), (1, 1))

WALLPAPERS: tuple[tuple[Color, Color], ...] = (
    ((0.78, 0.80, 0.72), (0.45, 0.58, 0.50)), ((0.86, 0.78, 0.66), (0.66, 0.42, 0.34)),
    ((0.72, 0.78, 0.84), (0.36, 0.46, 0.62)), ((0.84, 0.80, 0.84), (0.52, 0.38, 0.54)),
)  # fmt: skip
SOFAS: tuple[Color, ...] = ((0.20, 0.40, 0.46), (0.56, 0.26, 0.22), (0.30, 0.36, 0.24), (0.34, 0.30, 0.46))


@dataclass
class Room:
    """The shapes of one room. `place` uses room coordinates and mirrors every second room in x."""

    number: int
    seed: int
    shapes: list[Shape] = field(default_factory=list)

    def place(
        self, kind: Kind, center: Triple, half: Triple, material: Material | Texture, yaw_rad: float = 0.0
    ) -> None:
        """Add a shape: centre and half extents in metres; if `material` is only a texture, the material is matt."""
        side = -1.0 if self.number % 2 else 1.0
        x, y, z = center
        made = material if isinstance(material, Material) else Material(material)
        at = np.array([side * x + self.number * PITCH_M, y, z], np.float32)
        self.shapes.append(Shape(kind, at, np.array(half, np.float32), side * yaw_rad, made))

    def pick(self, choices: int) -> int:
        """Return which of several variants to use: by the seed, and different in neighbouring rooms."""
        return (self.seed + self.number) % choices


def furnish_rooms(rooms: int, seed: int) -> list[list[Shape]]:
    """Build a row of furnished rooms; return the shapes of each, a shared wall with the earlier room."""
    built = []
    for number in range(rooms):
        room = Room(number, seed)
        _shell(room, rooms)
        for furnish in (_north_wall, _south_wall, _corners, _middle):
            furnish(room, 1000 * seed + 100 * number)
        built.append(room.shapes)
    return built


def _shell(room: Room, rooms: int) -> None:
    """Build floor, ceiling and walls; door walls are shared with the next room."""
    seed, half = room.seed * 10 + room.number, WALL_M / 2
    ground, figure = WALLPAPERS[room.pick(len(WALLPAPERS))]
    span_x, middle_z = PITCH_M / 2, HEIGHT_M / 2  # neighbouring rooms meet inside the shared wall
    place = room.place
    place("box", (0, 0, -half), (span_x, HALF_Y_M + WALL_M, half), wood((0.58, 0.42, 0.28), seed=seed))
    ceiling = plain((0.90, 0.89, 0.86), 0.04, 0.25, seed)
    place("box", (0, 0, HEIGHT_M + half), (span_x, HALF_Y_M + WALL_M, half), ceiling)
    place("box", (0, HALF_Y_M + half, middle_z), (span_x, half, middle_z), wallpaper(ground, figure, 0.34, seed))
    south = two_tone((0.86, 0.82, 0.72), (0.50, 0.58, 0.60), 0.95 - middle_z, seed)
    place("box", (0, -HALF_Y_M - half, middle_z), (span_x, half, middle_z), south)
    bare = plain((0.84, 0.82, 0.78), 0.006, 0.5, seed)  # the nearly textureless wall
    bricks = brick((0.66, 0.42, 0.34), (0.80, 0.77, 0.72), seed)
    away = -1.0 if room.number % 2 else 1.0  # x of the wall towards the next room, before mirroring
    _wall(room, away * (HALF_X_M + half), bare if away > 0 else bricks, room.number < rooms - 1)
    if room.number == 0:
        _wall(room, -HALF_X_M - half, bricks, False)


def _wall(room: Room, x: float, texture: Texture, door: bool) -> None:
    if not door:
        room.place("box", (x, 0, HEIGHT_M / 2), (WALL_M / 2, HALF_Y_M, HEIGHT_M / 2), texture)
        return
    half = (HALF_Y_M - DOOR_HALF_M) / 2
    for side in (-1, 1):
        room.place("box", (x, side * (DOOR_HALF_M + half), HEIGHT_M / 2), (WALL_M / 2, half, HEIGHT_M / 2), texture)
    lintel = (HEIGHT_M - DOOR_HEIGHT_M) / 2
    room.place("box", (x, 0, HEIGHT_M - lintel), (WALL_M / 2, DOOR_HALF_M, lintel), texture)
    room.place("box", (x, 0, 0.0), (WALL_M / 2 + 0.02, DOOR_HALF_M, 0.008), plain((0.36, 0.25, 0.17), 0.1))  # the sill


def _north_wall(room: Room, seed: int) -> None:
    """Add bookshelf, sofa, painting and floor lamp along the wall with wallpaper."""
    place = room.place
    _bookshelf(room, -1.62, seed)
    cloth = SOFAS[room.pick(len(SOFAS))]
    pale: Color = (min(cloth[0] + 0.14, 1), min(cloth[1] + 0.14, 1), min(cloth[2] + 0.14, 1))
    fabric = weave(cloth, pale, 0.05, seed)
    place("box", (0.35, 1.5, 0.24), (0.82, 0.38, 0.2), fabric)
    place("box", (0.35, 1.84, 0.5), (0.82, 0.12, 0.36), weave(cloth, pale, 0.06, seed + 1))
    for side in (-1, 1):
        place("box", (0.35 + side * 0.9, 1.52, 0.32), (0.1, 0.4, 0.3), fabric)
    place("ball", (-0.1, 1.66, 0.58), (0.2, 0.11, 0.17), checks((0.86, 0.78, 0.58), (0.72, 0.34, 0.24), 0.06, seed))
    place("ball", (0.85, 1.64, 0.57), (0.2, 0.12, 0.17), weave((0.82, 0.72, 0.30), (0.92, 0.86, 0.62), 0.05, seed))
    place("box", (0.4, 1.985, 1.62), (0.58, 0.02, 0.4), painting(0.58, 0.4, seed + 11))
    place("drum", (1.8, 1.5, 0.02), (0.16, 0.16, 0.02), plain((0.25, 0.24, 0.23)))
    place("drum", (1.8, 1.5, 0.75), (0.016, 0.016, 0.75), plain((0.30, 0.28, 0.25)))
    place("drum", (1.8, 1.5, 1.62), (0.2, 0.2, 0.15), Material(plain((0.98, 0.90, 0.72), 0.05), glow=0.85))


def _bookshelf(room: Room, x: float, seed: int) -> None:
    """Add a bookshelf with four boards; each board holds three groups of books of different height."""
    timber = wood((0.46, 0.31, 0.19), 0.11, seed)
    upright = wood((0.44, 0.30, 0.18), 0.2, seed + 1)
    room.place("box", (x, 1.97, 0.95), (0.62, 0.02, 0.95), upright)
    for side in (-1, 1):
        room.place("box", (x + side * 0.6, 1.82, 0.95), (0.02, 0.16, 0.95), upright)
    rng = np.random.default_rng((seed, 1))
    for board, z in enumerate((0.06, 0.52, 0.98, 1.44, 1.88)):
        room.place("box", (x, 1.82, z), (0.6, 0.16, 0.018), timber)
        if board == 4:
            break
        for group, offset in enumerate((-0.37, 0.0, 0.36)):
            half_z = float(rng.uniform(0.11, 0.19))
            look = books(float(rng.uniform(0.035, 0.06)), seed + 10 * board + group)
            half_x = float(rng.uniform(0.12, 0.175))
            room.place("box", (x + offset, 1.85, z + 0.018 + half_z), (half_x, 0.1, half_z), look)


def _south_wall(room: Room, seed: int) -> None:
    """Add window, sideboard with a vase, and mirror along the two-tone wall."""
    place = room.place
    place("box", (-0.85, -1.985, 1.6), (0.72, 0.02, 0.5), Material(sky(0.5), glow=1.0))
    white = plain((0.93, 0.92, 0.89), 0.02)
    for x, z, half_x, half_z in (
        (-0.85, 2.12, 0.78, 0.035), (-0.85, 1.08, 0.82, 0.04), (-1.6, 1.6, 0.035, 0.5), (-0.1, 1.6, 0.035, 0.5),
        (-0.85, 1.6, 0.022, 0.5),
    ):  # fmt: skip
        place("box", (x, -1.97, z), (half_x, 0.045, half_z), white)
    place("box", (-0.85, -1.74, 0.36), (0.7, 0.24, 0.3), wood((0.50, 0.30, 0.20), 0.2, seed + 5, 0.47))
    place("box", (-0.85, -1.74, 0.68), (0.73, 0.26, 0.02), wood((0.62, 0.42, 0.28), 0.13, seed + 6))
    vase = Material(checks((0.2, 0.34, 0.6), (0.9, 0.9, 0.88), 0.04), gloss=0.3)
    place("ball", (-1.2, -1.72, 0.84), (0.1, 0.1, 0.15), vase)
    place("box", (-0.5, -1.74, 0.76), (0.13, 0.1, 0.06), books(0.03, seed + 7), 0.35)
    place("box", (1.25, -1.985, 1.35), (0.5, 0.02, 0.68), wood((0.55, 0.42, 0.20), 0.08, seed + 8))
    place("box", (1.25, -1.965, 1.35), (0.45, 0.012, 0.63), Material(plain((0.62, 0.66, 0.68), 0.0), mirror=0.8))


def _corners(room: Room, seed: int) -> None:
    """Add a plant, crates and small paintings near the side walls; the doorways stay free."""
    place = room.place
    place("drum", (-2.1, -1.5, 0.2), (0.19, 0.19, 0.2), checks((0.70, 0.42, 0.30), (0.78, 0.52, 0.38), 0.08, seed))
    place("drum", (-2.1, -1.5, 0.6), (0.022, 0.022, 0.25), plain((0.36, 0.26, 0.16)))
    rng = np.random.default_rng((seed, 2))
    for k in range(6):
        angle, radius = k * 2.1, 0.08 + 0.03 * k
        size = float(rng.uniform(0.13, 0.19))
        x, y = -2.1 + radius * float(np.cos(angle)), -1.5 + radius * float(np.sin(angle))
        place("ball", (x, y, 0.8 + 0.085 * k), (size, size, 0.8 * size), leaves(seed + k))
    place("box", (2.12, -1.6, 0.24), (0.28, 0.28, 0.24), wood((0.72, 0.56, 0.36), 0.12, seed + 3), 0.12)
    place("box", (2.1, -1.62, 0.64), (0.2, 0.2, 0.16), checks((0.30, 0.42, 0.58), (0.78, 0.80, 0.78), 0.08, seed), 0.5)
    place("box", (1.58, -1.66, 0.17), (0.2, 0.2, 0.17), weave((0.62, 0.50, 0.34), (0.80, 0.70, 0.52), 0.07, seed), -0.3)
    place("box", (-2.485, 1.15, 1.5), (0.02, 0.34, 0.42), painting(0.34, 0.42, seed + 21, (0.16, 0.15, 0.15)))
    place("box", (-2.485, -1.0, 1.6), (0.02, 0.26, 0.26), painting(0.26, 0.26, seed + 22, (0.60, 0.48, 0.24)))


def _middle(room: Room, seed: int) -> None:
    """Add rug, table, chairs, objects on the table and the ceiling lamp in the middle."""
    place, turn = room.place, 0.25
    carpet = rug(1.15, (0.58, 0.20, 0.18), (0.85, 0.76, 0.58), (0.22, 0.26, 0.40), seed)
    place("drum", (0.1, 0.0, 0.008), (1.15, 1.15, 0.008), carpet)
    place("box", (0.1, 0.0, 0.70), (0.58, 0.36, 0.022), wood((0.68, 0.48, 0.30), 0.12, seed + 4, 2.0), turn)
    for sx, sy in LEGS:
        x, y = _rotated(0.5 * sx, 0.29 * sy, turn)
        place("drum", (0.1 + x, y, 0.34), (0.032, 0.032, 0.34), plain((0.42, 0.30, 0.20), 0.05))
    x, y = _rotated(0.22, 0.06, turn)
    chrome = Material(plain((0.42, 0.44, 0.48), 0.02), mirror=0.3, gloss=0.9)  # the specular sphere
    place("ball", (0.1 + x, y, 0.722 + 0.13), (0.13, 0.13, 0.13), chrome)
    x, y = _rotated(-0.3, 0.1, turn)
    cube = checks((0.86, 0.62, 0.18), (0.22, 0.24, 0.30), 0.06, seed)
    place("box", (0.1 + x, y, 0.722 + 0.09), (0.09, 0.09, 0.09), cube, 0.7)
    x, y = _rotated(-0.12, -0.17, turn)
    place("box", (0.1 + x, y, 0.722 + 0.03), (0.14, 0.1, 0.03), books(0.06, seed + 9), 0.1)
    x, y = _rotated(0.4, -0.15, turn)
    place("drum", (0.1 + x, y, 0.772), (0.042, 0.042, 0.05), Material(plain((0.75, 0.25, 0.2), 0.05), gloss=0.25))
    for x, y, yaw_rad in ((-0.75, -0.45, 0.5), (0.95, 0.5, 2.9)):
        _chair(room, x, y, yaw_rad, seed)
    place("drum", (0.0, 0.0, HEIGHT_M - 0.06), (0.3, 0.3, 0.05), Material(plain((1.0, 0.97, 0.90), 0.01), glow=1.0))


def _chair(room: Room, x: float, y: float, yaw_rad: float, seed: int) -> None:
    timber = wood((0.40, 0.27, 0.18), 0.06, seed + 12)
    seat = weave((0.52, 0.20, 0.18), (0.72, 0.42, 0.34), 0.05, seed)
    room.place("box", (x, y, 0.44), (0.2, 0.2, 0.025), seat, yaw_rad)
    back_x, back_y = _rotated(-0.19, 0.0, yaw_rad)
    room.place("box", (x + back_x, y + back_y, 0.72), (0.018, 0.2, 0.2), timber, yaw_rad)
    for sx, sy in LEGS:
        leg_x, leg_y = _rotated(0.175 * sx, 0.175 * sy, yaw_rad)
        height = 0.36 if sx < 0 else 0.21  # the posts of the back are taller
        room.place("box", (x + leg_x, y + leg_y, height), (0.02, 0.02, height), timber, yaw_rad)


def _rotated(x: float, y: float, angle_rad: float) -> tuple[float, float]:
    c, s = float(np.cos(angle_rad)), float(np.sin(angle_rad))
    return c * x - s * y, s * x + c * y


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
    hit = ball.first_hit(T_world_camera[:3, 3:].astype(np.float32), R @ rays).reshape(depth_m.shape)
    return np.isfinite(hit) & (hit <= depth_m + 1e-4)
