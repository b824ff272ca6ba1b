"""A long wall seen from the front: depth does not show how far the camera has gone along it, only the paint does."""

import numpy as np

from sigmasplat.api import Matrix
from sigmasplat.plugins.sources.room.capture import pose
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, HEIGHT_M, PITCH_M, WALL_M, Room
from sigmasplat.plugins.sources.room.shapes import Shape
from sigmasplat.plugins.sources.room.textures import plain, tiles

AWAY_M, STEP_M, MARGIN_M = 1.2, 0.07, 2.0
"""Distance of the camera from the wall, its motion from frame to frame, and what the wall is longer than the way."""
EYE_M, BOB_M, NOD_RAD = 1.45, 0.03, 0.02
PERIODS = {"bob": 31, "nod": 43}
"""Frames in one period of how far it bobs up and down, and nods."""
COLOR, JOINT, TILE_M = (0.78, 0.76, 0.72), (0.45, 0.44, 0.42), 0.3
PAINTS = ("painted", "tiles", "blank")


def wall_sections(frames: int) -> int:
    """Return the number of sections, each as long as a room, of a wall for this number of frames."""
    return int(np.ceil((frames * STEP_M + 2 * MARGIN_M) / PITCH_M))


def furnish_wall(count: int, seed: int, paint: int) -> list[list[Shape]]:
    """Build a wall as long as `count` sections, painted as `PAINTS` says, from 1 on; return its shapes, all as of one
    section."""
    paints = plain(COLOR, 0.5, 0.12, 1000 * seed), tiles(COLOR, JOINT, TILE_M), plain(COLOR, 0.0)  # as in PAINTS
    whole, middle_x = Room(0, seed), (count - 1) * PITCH_M / 2
    half = PITCH_M * count / 2, WALL_M / 2, HEIGHT_M
    whole.place("box", (middle_x, WALL_M / 2, HEIGHT_M / 2), half, paints[paint - 1])
    return [whole.shapes]


def wall_path(frames: int, seed: int) -> Matrix:
    """Return T_world_camera [frames, 4, 4] of a camera that is carried along the wall, `STEP_M` a frame."""
    i, random = np.arange(frames), np.random.default_rng((seed, 15))
    wave = {name: np.sin(2 * np.pi * (i / period + random.uniform())) for name, period in PERIODS.items()}
    x = MARGIN_M - HALF_X_M + STEP_M * i
    at = np.column_stack([x, np.full(frames, -AWAY_M), EYE_M + BOB_M * wave["bob"]])
    return np.stack([pose(each, np.pi / 2, pitch, 0.0) for each, pitch in zip(at, NOD_RAD * wave["nod"], strict=True)])
