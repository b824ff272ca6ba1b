"""Long scenes along which a camera is carried: a corridor with plain walls, and a wall seen from the front.

In the corridor only fine speckle shows how far the camera has gone, at the wall only its paint, not depth. Edges along
the corridor (skirting, handrails, a duct below the ceiling) and depth look alike from everywhere, and the speckle is
seen on near walls only. In small images, few pixels of it stand against all these edges. So alignment from coarse to
fine slides along the corridor, although depth agrees; images of full size alone do not let it slide.
"""

import numpy as np

from sigmasplat.api import Matrix
from sigmasplat.plugins.sources.room.capture import pose
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, HEIGHT_M, PITCH_M, WALL_M, Room
from sigmasplat.plugins.sources.room.shapes import Shape
from sigmasplat.plugins.sources.room.textures import painting, plain, tiles

HALF_WIDTH_M, STEP_M = 1.1, 0.08
"""Half of the width, and the distance between the cameras of successive frames."""
START_X_M, AHEAD_M = -1.8, 5.0
"""Place of the first frame, and the least length of the corridor beyond the last one."""
EYE_M, SWAY_M, BOB_M = 1.45, 0.12, 0.03
"""Height of the camera in both, and how far it sways to the sides and up."""
DOWN_RAD, YAW_RAD, PITCH_RAD, ROLL_RAD = np.deg2rad([4.0, 7.0, 3.0, 1.0])
"""How far the camera looks down on average, and how far it turns from there."""
PERIODS = {"sway": 61, "bob": 17, "yaw": 83, "pitch": 47}
"""Frames in one period of each; it rolls as it bobs."""
WALL, FLOOR, CEILING = (0.84, 0.83, 0.80), (0.78, 0.78, 0.77), (0.86, 0.86, 0.84)
SKIRTING, RAIL = (0.74, 0.74, 0.74), (0.70, 0.68, 0.64)
GRAIN, CELL_M = 0.10, 0.02
"""Contrast and size of the speckle. Weaker or finer, full size shows too little too; larger, small images show it."""


def sections(frames: int) -> int:
    """Return the number of sections, each as long as a room, of a corridor for this number of frames."""
    return int(np.ceil((HALF_X_M + START_X_M + frames * STEP_M + AHEAD_M) / PITCH_M))


def furnish_corridor(count: int, seed: int) -> list[list[Shape]]:
    """Build a corridor of sections along x; return the shapes of each. There are paintings in the first section only:
    without a first motion that is easy to find, nothing tells how fast the camera goes."""
    built, half, middle_z = [], WALL_M / 2, HEIGHT_M / 2
    for number in range(count):
        room, span, own = Room(number, seed), PITCH_M / 2, 1000 * seed + 10 * number
        place = room.place
        place("box", (0, 0, -half), (span, 2.0, half), plain(FLOOR, GRAIN, CELL_M, own))
        place("box", (0, 0, HEIGHT_M + half), (span, 2.0, half), plain(CEILING, GRAIN, CELL_M, own + 1))
        place("box", (0, 0.3, HEIGHT_M), (span, 0.15, 0.06), plain(RAIL, 0.0))
        for y, wall in ((-HALF_WIDTH_M, own + 2), (HALF_WIDTH_M, own + 4)):
            outside = y + np.copysign(half, y)
            place("box", (0, outside, middle_z), (span, half, middle_z), plain(WALL, GRAIN, CELL_M, wall))
            place("box", (0, y, 0.05), (span, 0.012, 0.05), plain(SKIRTING, 0.0))
            place("box", (0, y, 0.9), (span, 0.04, 0.05), plain(RAIL, 0.0))
            for k in range(5 if number == 0 else 0):
                picture = painting(0.38, 0.3, wall + 10 * k)
                place("box", (-1.9 + 0.95 * k, y, 1.5), (0.38, 0.012, 0.3), picture)
        for end, x in ((0, -HALF_X_M - half), (count - 1, HALF_X_M + half)):
            if number == end:  # `place` mirrors every second section
                at = (-x if number % 2 else x, 0, middle_z)
                place("box", at, (half, HALF_WIDTH_M, middle_z), plain(WALL, GRAIN, CELL_M, own + 6))
        built.append(room.shapes)
    return built


def corridor_path(frames: int, seed: int) -> Matrix:
    """Return T_world_camera [frames, 4, 4] of a camera that is carried along the corridor, `STEP_M` a frame."""
    wave = _waves(frames, (seed, 14), PERIODS)
    y, z = SWAY_M * wave["sway"], EYE_M + BOB_M * wave["bob"]
    ahead_m = np.sqrt(STEP_M**2 - np.diff(y) ** 2 - np.diff(z) ** 2)
    x = START_X_M + np.concatenate([[0.0], np.cumsum(ahead_m)])
    angles = YAW_RAD * wave["yaw"], PITCH_RAD * wave["pitch"] - DOWN_RAD, ROLL_RAD * wave["bob"]
    return np.stack([pose(at, *turned) for at, *turned in zip(np.column_stack([x, y, z]), *angles, strict=True)])


def _waves(frames: int, seed: tuple[int, int], periods: dict[str, int]) -> dict[str, Matrix]:
    """Return sine waves [frames] of amplitude 1 with random phases, by name."""
    i, random = np.arange(frames), np.random.default_rng(seed)
    return {name: np.sin(2 * np.pi * (i / period + random.uniform())) for name, period in periods.items()}


AWAY_M, WALL_STEP_M, MARGIN_M = 1.2, 0.07, 2.0
"""Distance of the camera from the wall, its motion from frame to frame, and what the wall is longer than the way."""
NOD_RAD, WALL_PERIODS = 0.02, {"bob": 31, "nod": 43}
"""How far it nods at the wall; frames in one period of how far it bobs up and down, and nods."""
COLOR, JOINT, TILE_M = (0.78, 0.76, 0.72), (0.45, 0.44, 0.42), 0.3
PAINTS = ("painted", "tiles", "blank")


def wall_sections(frames: int) -> int:
    """Return the number of sections, each as long as a room, of a wall for this number of frames."""
    return int(np.ceil((frames * WALL_STEP_M + 2 * MARGIN_M) / PITCH_M))


def furnish_wall(count: int, seed: int, paint: int) -> list[list[Shape]]:
    """Build a wall as long as `count` sections, painted as `PAINTS` says, from 1 on; return its shapes, all as of one
    section."""
    paints = plain(COLOR, 0.5, 0.12, 1000 * seed), tiles(COLOR, JOINT, TILE_M), plain(COLOR, 0.0)  # as in PAINTS
    whole, middle_x = Room(0, seed), (count - 1) * PITCH_M / 2
    half = PITCH_M * count / 2, WALL_M / 2, HEIGHT_M
    whole.place("box", (middle_x, WALL_M / 2, HEIGHT_M / 2), half, paints[paint - 1])
    return [whole.shapes]


def wall_path(frames: int, seed: int) -> Matrix:
    """Return T_world_camera [frames, 4, 4] of a camera that is carried along the wall, `WALL_STEP_M` a frame."""
    wave, x = _waves(frames, (seed, 15), WALL_PERIODS), MARGIN_M - HALF_X_M + WALL_STEP_M * np.arange(frames)
    at = np.column_stack([x, np.full(frames, -AWAY_M), EYE_M + BOB_M * wave["bob"]])
    return np.stack([pose(each, np.pi / 2, pitch, 0.0) for each, pitch in zip(at, NOD_RAD * wave["nod"], strict=True)])
