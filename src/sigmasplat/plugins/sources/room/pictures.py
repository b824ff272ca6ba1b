"""Textures with pictures: books, paintings, rugs, leaves, sky."""

import numpy as np

from sigmasplat.plugins.sources.room.textures import (
    Color,
    Floats,
    Texture,
    detail_visibility,
    draw_line,
    hash_cell,
    mix,
    noise,
    smoothstep,
    step,
)

SPINES: tuple[Color, ...] = (
    (0.62, 0.16, 0.14),
    (0.14, 0.28, 0.46),
    (0.85, 0.76, 0.55),
    (0.16, 0.38, 0.28),
    (0.80, 0.48, 0.14),
    (0.30, 0.20, 0.32),
    (0.75, 0.78, 0.80),
    (0.20, 0.20, 0.22),
)


PALETTES: tuple[tuple[Color, ...], ...] = (  # from the foreground up to the sky
    ((0.20, 0.26, 0.22), (0.36, 0.44, 0.32), (0.66, 0.64, 0.44), (0.74, 0.72, 0.68), (0.62, 0.74, 0.82)),
    ((0.24, 0.16, 0.18), (0.52, 0.26, 0.22), (0.78, 0.46, 0.28), (0.90, 0.70, 0.46), (0.94, 0.84, 0.70)),
    ((0.12, 0.20, 0.30), (0.18, 0.36, 0.46), (0.36, 0.56, 0.60), (0.66, 0.76, 0.74), (0.88, 0.86, 0.78)),
    ((0.28, 0.24, 0.34), (0.46, 0.38, 0.50), (0.70, 0.54, 0.58), (0.86, 0.70, 0.62), (0.76, 0.80, 0.86)),
)


def books(spine_m: float, seed: int = 0) -> Texture:
    """Return a texture of books side by side along u: random colours, dark gaps, pale labels."""

    def texture(u: Floats, v: Floats, pixel_m: Floats) -> Floats:
        number = np.floor(u / np.float32(spine_m))
        palette = np.array(SPINES, np.float32)
        chosen = palette[(hash_cell(number, 0, seed) * len(SPINES)).astype(int) % len(SPINES)].T
        seen = detail_visibility(spine_m, pixel_m)
        body = mix(palette.mean(0), chosen, seen)
        label = draw_line(v - (hash_cell(number, 1, seed) - 0.3) * np.float32(0.1), 0.02, pixel_m) * seen
        gap = draw_line((np.abs(u / np.float32(spine_m) - number - 0.5) - 0.5) * spine_m, 0.005, pixel_m)
        return mix(body, (0.86, 0.8, 0.62), 0.7 * label) * (1.0 - 0.7 * gap)

    return texture


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


def rug(radius_m: float, a: Color, b: Color, c: Color, seed: int = 0) -> Texture:
    """Return a texture of a round rug: rings, petals and pile."""

    def texture(u: Floats, v: Floats, pixel_m: Floats) -> Floats:
        r = np.hypot(u, v).astype(np.float32) / np.float32(radius_m)
        angle = np.arctan2(v, u).astype(np.float32)
        petals = smoothstep(0.5 + 2.0 * np.sin(12 * angle) * np.sin(np.float32(3 * np.pi) * r)) * detail_visibility(
            0.1, pixel_m
        )
        rings = smoothstep(0.5 + 2.0 * np.sin(np.float32(7 * np.pi) * r)) * detail_visibility(0.1, pixel_m)
        pile = 1.0 + 0.12 * noise(u, v, pixel_m, 0.03, seed)
        return mix(mix(a, b, petals), c, 0.75 * rings) * pile

    return texture


def leaves(seed: int = 0) -> Texture:
    """Return a texture of foliage."""

    def texture(u: Floats, v: Floats, pixel_m: Floats) -> Floats:
        light = 0.5 + 0.5 * noise(u, v, pixel_m, 0.05, seed) + 0.25 * noise(u, v, pixel_m, 0.025, seed + 1)
        return mix((0.08, 0.22, 0.08), (0.42, 0.62, 0.22), light)

    return texture


def sky(half_v_m: float) -> Texture:
    """Return a texture of the view from a window: a bright sky over hills."""

    def texture(u: Floats, v: Floats, pixel_m: Floats) -> Floats:
        height = smoothstep(0.5 + v / np.float32(2 * half_v_m))
        air = mix((0.93, 0.95, 0.95), (0.55, 0.74, 0.93), height)
        hills = step(-v - np.float32(0.45 * half_v_m) + 0.12 * noise(u, v * 0, pixel_m, 0.35, 5), pixel_m, 0.02)
        return mix(air, (0.42, 0.55, 0.42), hills)

    return texture
