"""Plan a smooth closed camera path through the rooms."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from sigmasplat.plugins.sources.room.furnish import HALF_X_M, PITCH_M
from sigmasplat.types import Matrix

PATH_SAMPLES = 4000
"""Samples for measuring the length of a path."""
YAW_SMOOTHING_M = 0.9
"""Standard deviation, along the path, of the Gaussian that smooths the viewing direction."""


def camera_path(frames: int, loops: int, rooms: int, seed: int, overrun: float = 0.0) -> Matrix:
    """Return T_world_camera [frames, 4, 4], camera x right, y down, z forward. The last pose equals the first, or is
    `overrun` rounds beyond it, where the views of the start are seen again from the same places.

    One room: an ellipse, looking across it, one round per loop, each loop at another height; at 200 frames per loop the
    motion is 1.4 to 2.8 cm and below 2° per frame. Several rooms: through the doorways and back, looking ahead; the
    pace is equal at 300 frames per room, without the overrun.
    """
    u = np.arange(frames) / max(frames - 1, 1)
    phase = 2 * np.pi * np.random.default_rng((seed, 3)).uniform()
    all_turns = loops + overrun
    positions, yaw_rad = _ellipse(all_turns * u, phase) if rooms == 1 else _corridor((all_turns * u) % 1.0, rooms)
    turns = 2 * np.pi * all_turns * u
    positions[:, 2] = 1.42 + 0.07 * np.sin(2 * turns + phase) + 0.16 * np.sin(2 * np.pi * u) * (loops > 1)
    pitch_rad = np.deg2rad(-11.0 + 5.0 * np.sin(2 * turns))
    roll_rad = np.deg2rad(1.5) * np.sin(3 * turns)
    return np.stack([_pose(*values) for values in zip(positions, yaw_rad, pitch_rad, roll_rad, strict=True)])


def _ellipse(loop: Matrix, phase: float) -> tuple[Matrix, Matrix]:
    """Return positions and yaw on an ellipse about the room's centre, looking across it; yaw changes evenly."""
    yaw_rad = 2 * np.pi * loop + phase
    ahead = np.stack([0.85 * np.cos(yaw_rad), 0.65 * np.sin(yaw_rad), np.zeros_like(yaw_rad)], -1)
    return -ahead, yaw_rad


def _corridor(loop: Matrix, rooms: int) -> tuple[Matrix, Matrix]:
    """Return positions and yaw on a closed spline through all rooms and back, at constant speed."""
    doors = [HALF_X_M + k * PITCH_M for k in range(rooms - 1)]
    out: list[tuple[float, float]] = [(0.0, -0.75)]
    for k, x in enumerate(doors):
        out += [(x, -0.12), (PITCH_M * (k + 1), -0.75)]
    back = [(x, -y) for x, y in reversed(out)]
    turn_x = 1.15
    corners = [*out, (PITCH_M * (rooms - 1) + turn_x, 0.0), *back, (-turn_x, 0.0), out[0]]
    knots = np.array(corners)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    curve = CubicSpline(length, knots, bc_type="periodic")
    fine = np.linspace(0.0, length[-1], PATH_SAMPLES + 1)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    where = np.interp(loop * travelled[-1], travelled, fine)
    yaw_rad = _smooth_yaw(
        curve(np.interp(np.linspace(0, travelled[-1], PATH_SAMPLES + 1), travelled, fine), 1), travelled[-1]
    )
    return np.column_stack([curve(where), np.zeros(len(loop))]), np.interp(
        loop, np.linspace(0, 1, PATH_SAMPLES + 1), yaw_rad
    )


def _smooth_yaw(ahead: Matrix, length_m: float) -> Matrix:
    """Return the yaw of a closed path's directions, evenly spaced, smoothed so that turns begin early."""
    turn = np.linspace(0.0, 2 * np.pi, len(ahead))
    wobble = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) - turn
    calm = gaussian_filter1d(wobble[:-1], YAW_SMOOTHING_M / length_m * PATH_SAMPLES, mode="wrap")
    return np.asarray(turn + np.append(calm, calm[0]))


def _pose(position: Matrix, yaw_rad: float, pitch_rad: float, roll_rad: float) -> Matrix:
    """Return the pose with this yaw (from +x about z), pitch (up is positive) and roll about the viewing direction."""
    forward = np.array([np.cos(pitch_rad) * np.cos(yaw_rad), np.cos(pitch_rad) * np.sin(yaw_rad), np.sin(pitch_rad)])
    right = np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = c * right + s * down, c * down - s * right, forward
    T[:3, 3] = position
    return T
