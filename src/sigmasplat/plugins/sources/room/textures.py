"""Procedural textures without detail below the size of a pixel: materials, and pictures such as books and paintings.

A texture maps surface coordinates u, v [N] and the pixel's width on the surface [N], all metres, to RGB [3, N] in
[0, 1], display values. Every pattern fades to its mean when the pixel becomes larger than the pattern. Otherwise
distant surfaces would alias, and no map can explain noise that changes with the viewpoint.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]  # values are float32, but the type of their products is wider
Texture = Callable[[Floats, Floats, Floats], Floats]
Color = tuple[float, float, float]
Options = ParamSpec("Options")


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a surface: texture; glow = emitted share (1 = no other light); mirror = share of the reflected ray;
    gloss = strength of highlights."""

    texture: Texture
    glow: float = 0.0
    mirror: float = 0.0
    gloss: float = 0.0


def hash_cell(i: Floats, j: Floats | int, seed: int) -> Floats:
    """Return a pseudo-random number in [0, 1) for each integer cell (i, j), equal on every machine."""
    a = np.atleast_1d(np.asarray(i, np.int32)).view(np.uint32) * np.uint32(0x9E3779B1)
    b = np.atleast_1d(np.asarray(j, np.int32)).view(np.uint32) * np.uint32(0x85EBCA77)
    h = a ^ b ^ np.uint32((seed * 0xC2B2AE3D + 0x27D4EB2F) & 0xFFFFFFFF)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return ((h ^ (h >> np.uint32(15))) >> np.uint32(8)).astype(np.float32) / np.float32(1 << 24)


def smoothstep(x: Floats) -> Floats:
    """Return a smooth step from 0 at x ≤ 0 to 1 at x ≥ 1."""
    x = np.clip(x, 0.0, 1.0)
    return (x * x * (3.0 - 2.0 * x)).astype(np.float32)


def detail_visibility(detail_m: float, pixel_m: Floats) -> Floats:
    """Return the contrast, 1 … 0, that remains of details of this size for pixels of that size."""
    return smoothstep(2.0 - 2.0 * pixel_m / np.float32(detail_m))


def noise(u: Floats, v: Floats, pixel_m: Floats, cell_m: float, seed: int) -> Floats:
    """Return smooth random values in [−1, 1], one independent value per lattice point `cell_m` apart."""
    x, y = u / np.float32(cell_m), v / np.float32(cell_m)
    i, j = np.floor(x), np.floor(y)
    a, b = smoothstep(x - i), smoothstep(y - j)
    low = hash_cell(i, j, seed) * (1 - a) + hash_cell(i + 1, j, seed) * a
    high = hash_cell(i, j + 1, seed) * (1 - a) + hash_cell(i + 1, j + 1, seed) * a
    return ((low * (1 - b) + high * b) * 2 - 1) * detail_visibility(cell_m, pixel_m)


def draw_line(distance_m: Floats, width_m: float, pixel_m: Floats) -> Floats:
    """Return the coverage of a line: 1 on it, 0 away from it, partial if it is thinner than a pixel."""
    soft = np.maximum(np.float32(width_m), pixel_m)
    return smoothstep(1.0 - np.abs(distance_m) / soft) * (np.float32(width_m) / soft)


def step(x_m: Floats, pixel_m: Floats, soft_m: float = 0.004) -> Floats:
    """Return a step from 0 to 1 at x = 0, one pixel wide."""
    return smoothstep(0.5 + x_m / np.maximum(2 * pixel_m, np.float32(soft_m)))


def mix(a: Color | Floats, b: Color | Floats, share: Floats) -> Floats:
    """Blend two colours by the share [N] of the second; returns [3, N]."""
    first, second = _column(a), _column(b)
    return (first + (second - first) * share).astype(np.float32)


def _column(color: Color | Floats) -> Floats:
    array = np.asarray(color, np.float32)
    return array[:, None] if array.ndim == 1 else array


def _texture(paint: Callable[Concatenate[Floats, Floats, Floats, Options], Floats]) -> Callable[Options, Texture]:
    """Turn a function of u, v, pixel_m and options into a function of the options that returns a texture."""

    @wraps(paint)
    def choose(*args: Options.args, **kwargs: Options.kwargs) -> Texture:
        return lambda u, v, pixel_m: paint(u, v, pixel_m, *args, **kwargs)

    return choose


@_texture
def plain(
    u: Floats, v: Floats, pixel_m: Floats, color: Color, grain: float = 0.03, cell_m: float = 0.09, seed: int = 0
) -> Floats:
    """Paint one colour with weak noise of amplitude `grain`."""
    clouds = 0.6 * noise(u, v, pixel_m, cell_m, seed) + 0.4 * noise(u, v, pixel_m, 0.37 * cell_m, seed + 1)
    return _column(color) * (1.0 + np.float32(grain) * clouds)


@_texture
def wood(
    u: Floats, v: Floats, pixel_m: Floats, color: Color, plank_m: float = 0.14, seed: int = 0, length_m: float = 1.1
) -> Floats:
    """Paint planks along u: each with its own tone, grain and dark seams."""
    row = np.floor(v / np.float32(plank_m))
    along = u + hash_cell(row, 0, seed) * np.float32(length_m)
    plank = np.floor(along / np.float32(length_m))
    tone = (hash_cell(row, plank, seed + 1) - 0.5) * detail_visibility(plank_m, pixel_m)
    grain = noise(u * 0.16, v, pixel_m, 0.016, seed + 2) + noise(u * 0.2, v, pixel_m, 0.045, seed + 3)
    across = np.abs(v / np.float32(plank_m) - row - 0.5) * np.float32(plank_m)
    ends = np.abs(along / np.float32(length_m) - plank - 0.5) * np.float32(length_m)
    seam = np.maximum(draw_line(across - plank_m / 2, 0.006, pixel_m), draw_line(ends - length_m / 2, 0.006, pixel_m))
    return _column(color) * (1.0 + 0.3 * tone + 0.09 * grain) * (1.0 - 0.4 * seam)


@_texture
def wallpaper(
    u: Floats, v: Floats, pixel_m: Floats, ground: Color, figure: Color, period_m: float, seed: int = 0
) -> Floats:
    """Paint wide stripes and a lattice of soft flowers with weak noise."""
    k = np.float32(2 * np.pi / period_m)
    stripes = 0.35 * smoothstep(0.5 + 1.5 * np.sin(k * u)) * detail_visibility(period_m / 3, pixel_m)
    flower = np.cos(k * u) * np.cos(k * v) + 0.55 * np.cos(2 * k * (u + v)) * np.cos(2 * k * (u - v))
    flowers = 0.6 * smoothstep(2.2 * flower - 1.0) * detail_visibility(period_m / 5, pixel_m)
    clouds = 0.05 * noise(u, v, pixel_m, 0.21, seed) + 0.05 * noise(u, v, pixel_m, 0.05, seed + 1)
    return mix(ground, figure, stripes + flowers) * (1.0 + clouds)


@_texture
def brick(u: Floats, v: Floats, pixel_m: Floats, color: Color, mortar: Color, seed: int = 0) -> Floats:
    """Paint bricks in half bond, each with its own tone."""
    width_m, height_m = 0.26, 0.09
    row = np.floor(v / np.float32(height_m))
    x = u / np.float32(width_m) + 0.5 * (row % 2)
    column = np.floor(x)
    tone = (hash_cell(row, column, seed) - 0.5) * detail_visibility(height_m, pixel_m)
    rough = noise(u, v, pixel_m, 0.03, seed + 1)
    joint_u = draw_line((np.abs(x - column - 0.5) - 0.5) * width_m, 0.011, pixel_m)
    joint_v = draw_line((np.abs(v / np.float32(height_m) - row - 0.5) - 0.5) * height_m, 0.011, pixel_m)
    return mix(_column(color) * (1.0 + 0.32 * tone + 0.07 * rough), mortar, np.maximum(joint_u, joint_v))


@_texture
def tiles(u: Floats, v: Floats, pixel_m: Floats, color: Color, joint: Color, size_m: float) -> Floats:
    """Paint square tiles that are all alike."""
    lines = [
        draw_line(np.abs(x / size_m - np.floor(x / size_m) - 0.5) * size_m - size_m / 2, 0.008, pixel_m) for x in (u, v)
    ]
    return mix(color, joint, np.maximum(*lines))


@_texture
def two_tone(
    u: Floats, v: Floats, pixel_m: Floats, upper: Color, lower: Color, height_m: float, seed: int = 0
) -> Floats:
    """Paint a wall in two colours with a pale band between them at v = `height_m`."""
    plaster = 0.04 * noise(u, v, pixel_m, 0.3, seed) + 0.05 * noise(u, v, pixel_m, 0.06, seed + 1)
    paint = mix(lower, upper, step(v - np.float32(height_m), pixel_m))
    panel = draw_line(np.abs(u / 0.5 - np.floor(u / 0.5) - 0.5) * 0.5 - 0.25, 0.012, pixel_m) * (v < height_m)
    band = draw_line(v - np.float32(height_m), 0.035, pixel_m)
    return mix(mix(paint, (0.35, 0.33, 0.3), 0.5 * panel), (0.93, 0.91, 0.86), band) * (1.0 + plaster)


@_texture
def checks(u: Floats, v: Floats, pixel_m: Floats, a: Color, b: Color, size_m: float, seed: int = 0) -> Floats:
    """Paint soft checks in two colours."""
    k = np.float32(np.pi / size_m)
    wave = np.sin(k * u) * np.sin(k * v)
    share = 0.5 + (smoothstep(0.5 + 2.5 * wave) - 0.5) * detail_visibility(size_m, pixel_m)
    return mix(a, b, share) * (1.0 + 0.06 * noise(u, v, pixel_m, 0.02, seed))


@_texture
def weave(u: Floats, v: Floats, pixel_m: Floats, a: Color, b: Color, period_m: float, seed: int = 0) -> Floats:
    """Paint cloth: two crossing ribs and worn patches."""
    k = np.float32(2 * np.pi / period_m)
    ribs = (np.sin(k * u) + np.sin(k * v)) * 0.25 * detail_visibility(period_m / 2, pixel_m)
    worn = 0.35 * noise(u, v, pixel_m, 0.12, seed) + 0.25 * noise(u, v, pixel_m, 0.04, seed + 1)
    return mix(a, b, 0.5 + ribs + worn)


SPINES: tuple[Color, ...] = (
    (0.62, 0.16, 0.14), (0.14, 0.28, 0.46), (0.85, 0.76, 0.55), (0.16, 0.38, 0.28),
    (0.80, 0.48, 0.14), (0.30, 0.20, 0.32), (0.75, 0.78, 0.80), (0.20, 0.20, 0.22),
)  # fmt: skip
PALETTES: tuple[tuple[Color, ...], ...] = (  # from the foreground up to the sky
    ((0.20, 0.26, 0.22), (0.36, 0.44, 0.32), (0.66, 0.64, 0.44), (0.74, 0.72, 0.68), (0.62, 0.74, 0.82)),
    ((0.24, 0.16, 0.18), (0.52, 0.26, 0.22), (0.78, 0.46, 0.28), (0.90, 0.70, 0.46), (0.94, 0.84, 0.70)),
    ((0.12, 0.20, 0.30), (0.18, 0.36, 0.46), (0.36, 0.56, 0.60), (0.66, 0.76, 0.74), (0.88, 0.86, 0.78)),
    ((0.28, 0.24, 0.34), (0.46, 0.38, 0.50), (0.70, 0.54, 0.58), (0.86, 0.70, 0.62), (0.76, 0.80, 0.86)),
)


@_texture
def books(u: Floats, v: Floats, pixel_m: Floats, spine_m: float, seed: int = 0) -> Floats:
    """Paint books side by side along u: random colours, dark gaps, pale labels."""
    number = np.floor(u / np.float32(spine_m))
    palette = np.array(SPINES, np.float32)
    chosen = palette[(hash_cell(number, 0, seed) * len(SPINES)).astype(int) % len(SPINES)].T
    seen = detail_visibility(spine_m, pixel_m)
    body = mix(palette.mean(0), chosen, seen)
    label = draw_line(v - (hash_cell(number, 1, seed) - 0.3) * np.float32(0.1), 0.02, pixel_m) * seen
    gap = draw_line((np.abs(u / np.float32(spine_m) - number - 0.5) - 0.5) * spine_m, 0.005, pixel_m)
    return mix(body, (0.86, 0.8, 0.62), 0.7 * label) * (1.0 - 0.7 * gap)


def painting(half_u_m: float, half_v_m: float, seed: int, frame: Color = (0.32, 0.22, 0.12)) -> Texture:
    """Return a texture of a framed landscape: warped colour bands with a sun."""
    rng = np.random.default_rng(seed)
    bands = np.sort(rng.uniform(-0.8, 0.8, 4)).astype(np.float32)
    colors = np.array(PALETTES[int(rng.integers(len(PALETTES)))], np.float32)
    sun_u, sun_v = rng.uniform(-0.5, 0.5) * half_u_m, rng.uniform(0.2, 0.6) * half_v_m

    def texture(u: Floats, v: Floats, pixel_m: Floats) -> Floats:
        hill = 0.35 * half_v_m * noise(u, v * 0.4, pixel_m, 0.22, seed) + 0.03 * noise(u, v, pixel_m, 0.05, seed + 1)
        color = mix(colors[0], colors[0], np.zeros_like(u))
        for band, paint in zip(bands, colors[1:], strict=True):
            color = mix(color, paint, step(v + hill - band * np.float32(half_v_m), pixel_m, 0.02))
        sun = step(0.2 * half_v_m - np.hypot(u - sun_u, v - sun_v).astype(np.float32), pixel_m)
        color = mix(color, (0.95, 0.85, 0.55), sun) * (1.0 + 0.08 * noise(u, v, pixel_m, 0.025, seed + 2))
        edge = np.minimum(half_u_m - np.abs(u), half_v_m - np.abs(v)).astype(np.float32)
        passepartout = mix(color, (0.92, 0.9, 0.85), step(0.09 - edge, pixel_m))
        return mix(passepartout, frame, step(0.035 - edge, pixel_m))

    return texture


@_texture
def rug(u: Floats, v: Floats, pixel_m: Floats, radius_m: float, a: Color, b: Color, c: Color, seed: int = 0) -> Floats:
    """Paint a round rug: rings, petals and pile."""
    r = np.hypot(u, v).astype(np.float32) / np.float32(radius_m)
    angle = np.arctan2(v, u).astype(np.float32)
    seen = detail_visibility(0.1, pixel_m)
    petals = smoothstep(0.5 + 2.0 * np.sin(12 * angle) * np.sin(np.float32(3 * np.pi) * r)) * seen
    rings = smoothstep(0.5 + 2.0 * np.sin(np.float32(7 * np.pi) * r)) * seen
    pile = 1.0 + 0.12 * noise(u, v, pixel_m, 0.03, seed)
    return mix(mix(a, b, petals), c, 0.75 * rings) * pile


@_texture
def leaves(u: Floats, v: Floats, pixel_m: Floats, seed: int = 0) -> Floats:
    """Paint foliage."""
    light = 0.5 + 0.5 * noise(u, v, pixel_m, 0.05, seed) + 0.25 * noise(u, v, pixel_m, 0.025, seed + 1)
    return mix((0.08, 0.22, 0.08), (0.42, 0.62, 0.22), light)


@_texture
def sky(u: Floats, v: Floats, pixel_m: Floats, half_v_m: float) -> Floats:
    """Paint the view from a window: a bright sky over hills."""
    height = smoothstep(0.5 + v / np.float32(2 * half_v_m))
    air = mix((0.93, 0.95, 0.95), (0.55, 0.74, 0.93), height)
    hills = step(-v - np.float32(0.45 * half_v_m) + 0.12 * noise(u, v * 0, pixel_m, 0.35, 5), pixel_m, 0.02)
    return mix(air, (0.42, 0.55, 0.42), hills)
