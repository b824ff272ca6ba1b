"""Plan a smooth closed camera path through the rooms; add the noise of a structured-light sensor to exact images."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, map_coordinates, maximum_filter, minimum_filter, zoom

from sigmasplat.api import Camera, Matrix
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, PITCH_M

PATH_SAMPLES, YAW_SMOOTHING_M = 4000, 0.9
"""Samples for measuring the length of a path. Standard deviation, along it, of the Gaussian that smooths the viewing
direction."""


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
    positions, yaw_rad = _ellipse(all_turns * u, phase) if rooms == 1 else _through_rooms((all_turns * u) % 1.0, rooms)
    turns = 2 * np.pi * all_turns * u
    positions[:, 2] = 1.42 + 0.07 * np.sin(2 * turns + phase) + 0.16 * np.sin(2 * np.pi * u) * (loops > 1)
    pitch_rad = np.deg2rad(-11.0 + 5.0 * np.sin(2 * turns))
    roll_rad = np.deg2rad(1.5) * np.sin(3 * turns)
    return np.stack([pose(*values) for values in zip(positions, yaw_rad, pitch_rad, roll_rad, strict=True)])


def _ellipse(loop: Matrix, phase: float) -> tuple[Matrix, Matrix]:
    """Return positions and yaw on an ellipse about the room's centre, looking across it; yaw changes evenly."""
    yaw_rad = 2 * np.pi * loop + phase
    ahead = np.stack([0.85 * np.cos(yaw_rad), 0.65 * np.sin(yaw_rad), np.zeros_like(yaw_rad)], -1)
    return -ahead, yaw_rad


def _through_rooms(loop: Matrix, rooms: int) -> tuple[Matrix, Matrix]:
    """Return positions and yaw on a closed spline through all rooms and back, at constant speed."""
    doors = [HALF_X_M + k * PITCH_M for k in range(rooms - 1)]
    out: list[tuple[float, float]] = [(0.0, -0.75)]
    for k, x in enumerate(doors):
        out += [(x, -0.12), (PITCH_M * (k + 1), -0.75)]
    back = [(x, -y) for x, y in reversed(out)]
    turn_x = 1.15
    knots = np.array([*out, (PITCH_M * (rooms - 1) + turn_x, 0.0), *back, (-turn_x, 0.0), out[0]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    curve = CubicSpline(length, knots, bc_type="periodic")
    fine = np.linspace(0.0, length[-1], PATH_SAMPLES + 1)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    where = np.interp(loop * travelled[-1], travelled, fine)
    even_m, even = (np.linspace(0, end, PATH_SAMPLES + 1) for end in (travelled[-1], 1))
    yaw_rad = _smooth_yaw(curve(np.interp(even_m, travelled, fine), 1), travelled[-1])
    return np.column_stack([curve(where), np.zeros(len(loop))]), np.interp(loop, even, yaw_rad)


def _smooth_yaw(ahead: Matrix, length_m: float) -> Matrix:
    """Return the yaw of a closed path's directions, evenly spaced, smoothed so that turns begin early."""
    turn = np.linspace(0.0, 2 * np.pi, len(ahead))
    wobble = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) - turn
    calm = gaussian_filter1d(wobble[:-1], YAW_SMOOTHING_M / length_m * PATH_SAMPLES, mode="wrap")
    return np.asarray(turn + np.append(calm, calm[0]))


def pose(position: Matrix, yaw_rad: float, pitch_rad: float, roll_rad: float) -> Matrix:
    """Return the pose with this yaw (from +x about z), pitch (up is positive) and roll about the viewing direction."""
    forward = np.array([np.cos(pitch_rad) * np.cos(yaw_rad), np.cos(pitch_rad) * np.sin(yaw_rad), np.sin(pitch_rad)])
    right = np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = c * right + s * down, c * down - s * right, forward, position
    return T


Image = NDArray[np.float32]

JITTER_PX, RANGE_M, COLOR_SIGMA = 0.6, (0.35, 7.0), 0.008
PREDICTED_SCALE_ERROR, PREDICTED_NOISE = 0.1, 0.1
"""Standard deviations of predicted depth, shares of the depth: of its smooth error, and at each pixel."""
DRIFT_KNOT_FRAMES = 300
"""Frames between the random values of the calibration drift; it is a spline between them."""
EXPOSURE_SWING, STEP_FRAMES, MOVE_FRAMES = 0.08, 15, 4
"""Share by which a gain swings; mean time between steps of automatic exposure, and how long one takes."""


def camera_gains(frames: int, seed: int, exposure: float, white: float, swings: bool) -> Matrix:
    """Return the gains of red, green and blue in each frame [frames, 3].

    With `exposure`, all move to exp(exposure · a) at random times, within `MOVE_FRAMES`; with `white`, red moves to
    1 + white · b and blue to 1 − white · b, at times of their own. a and b are uniform in [−1, 1]. A gain that `swings`
    makes one sine period over the sequence.
    """
    i, random = np.arange(frames), np.random.default_rng((seed, 13)).random((frames, 4))
    latest = np.maximum.accumulate(np.where(random[:, :2] < 1 / STEP_FRAMES, i[:, None], 0))
    wanted = 2 * np.take_along_axis(random[:, 2:], latest, 0) - 1
    a, b = wanted[np.maximum(i[:, None] - np.arange(MOVE_FRAMES), 0)].mean(1).T
    sine = 1.0 + EXPOSURE_SWING * swings * np.sin(2 * np.pi * i / max(frames - 1, 1))
    return np.asarray((sine * np.exp(exposure * a))[:, None] * (1 + white * np.outer(b, [1, 0, -1])))


def shade(camera: Camera, falloff: float) -> Image:
    """Return the share of light [H, W, 1] that a lens lets through: 1 − falloff ρ², with ρ = 1 in the corners."""
    square = (camera.rays()[..., :2] ** 2).sum(-1, keepdims=True)
    return np.asarray(1 - falloff * square / (square.max() or 1.0))


def misread_depth(depth_m: Image, scale: float, offset: float) -> Image:
    """Return what a badly calibrated sensor reads for depth z [H, W]: 1/z' = 1/((1 + scale) z) + offset (per metre); 0
    without a reading, or if z' would be beyond infinity."""
    far_m = depth_m * np.float32(1 + scale)
    divisor = 1 + np.float32(offset) * far_m
    return np.asarray(np.divide(far_m, divisor, out=np.zeros_like(far_m), where=divisor > 0))


def noise_sigma_m(depth_m: Image) -> Image:
    """Return the standard deviation of Kinect depth, metres: 1.2 mm + 1.9 mm/m² (z − 0.4 m)² (Nguyen 2012)."""
    return (0.0012 + 0.0019 * (depth_m - 0.4) ** 2).astype(np.float32)


def measured_depth(depth_m: Image, camera: Camera, rng: np.random.Generator) -> Image:
    """Return noisy sensor depth for true depth [H, W]: jittered edges, noise that grows with z², holes as 0.

    Holes: grazing surfaces, a rim along depth discontinuities, random patches and speckles, and out-of-range depth.
    """
    seen = _jittered(depth_m, rng)
    noisy = seen + rng.standard_normal(seen.shape, np.float32) * noise_sigma_m(seen)
    in_range = (noisy > RANGE_M[0]) & (noisy < RANGE_M[1])
    blind = _grazing(depth_m, camera) | _rims(depth_m, rng) | _patches(depth_m.shape, rng)
    return np.where(in_range & ~blind, noisy, 0.0).astype(np.float32)


def drifted_depth(depth_m: Image, i: int, seed: int, deviation: float) -> Image:
    """Return the depth [H, W] read at frame i by a sensor whose calibration drifts as it warms up.

    The relative error is a polynomial of second degree over the image. Each coefficient is an independent smooth random
    process over the frames; `deviation` is the standard deviation of their sum, over image and time. The error depends
    only on seed and i, and changes slowly: neighbouring frames agree while the path drifts, as with a real sensor.
    """
    height, width = depth_m.shape
    v, u = np.linspace(-1.0, 1.0, height)[:, None], np.linspace(-1.0, 1.0, width)
    # Legendre polynomials: orthogonal, each with mean square 1, so that their variances add up.
    one, tilt_u, tilt_v = np.ones((height, width)), np.sqrt(3.0) * u, np.sqrt(3.0) * v
    shapes = (one, tilt_u, tilt_v, tilt_u * tilt_v, *(np.sqrt(1.25) * (3.0 * x**2 - 1.0) for x in (u, v)))
    error = sum(_smooth_process(i, (seed, k, 8)) * shape for k, shape in enumerate(shapes)) / np.sqrt(len(shapes))
    return np.asarray(depth_m * (1.0 + deviation * error), np.float32)


def predicted_depth(depth_m: Image, i: int, seed: int, rng: np.random.Generator) -> Image:
    """Return depth [H, W] as a network may predict it for frame i: true depth times a scale error of
    `PREDICTED_SCALE_ERROR` that changes slowly over image and time, with `PREDICTED_NOISE` at each pixel."""
    scaled = drifted_depth(depth_m, i, seed, PREDICTED_SCALE_ERROR)
    factor = 1.0 + PREDICTED_NOISE * rng.standard_normal(scaled.shape, np.float32)
    return np.where(depth_m > 0, np.maximum(scaled * factor, 0.0), 0.0).astype(np.float32)


def _smooth_process(i: int, seed: tuple[int, ...]) -> float:
    """Return a smooth random process of mean 0 and variance 1 at frame i: a cubic spline of normal numbers."""
    knot, s = divmod(i / DRIFT_KNOT_FRAMES, 1.0)
    weights = np.array([(1 - s) ** 3, 3 * s**3 - 6 * s**2 + 4, -3 * s**3 + 3 * s**2 + 3 * s + 1, s**3])
    normals = [np.random.default_rng((*seed, int(knot) + k)).standard_normal() for k in range(4)]
    return float(weights @ normals / np.linalg.norm(weights))


def measured_color(color: Image, rng: np.random.Generator) -> Image:
    """Return colour [H, W, 3] with image noise."""
    return np.clip(color + COLOR_SIGMA * rng.standard_normal(color.shape, np.float32), 0.0, 1.0)


def _jittered(depth_m: Image, rng: np.random.Generator) -> Image:
    """Sample every pixel at a random offset below a pixel: edges become noisy, surfaces hardly change."""
    v, u = np.indices(depth_m.shape, np.float32)
    offsets = rng.normal(0.0, JITTER_PX, (2, *depth_m.shape)).astype(np.float32)
    return np.asarray(map_coordinates(depth_m, [v + offsets[0], u + offsets[1]], order=0, mode="nearest"))


def _grazing(depth_m: Image, camera: Camera) -> NDArray[np.bool_]:
    """Mark surfaces seen at less than about 10°, where the light pattern is too distorted."""
    points = camera.rays() * depth_m[..., None]
    along_v, along_u = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normal = np.cross(along_u, along_v)
    norms = np.linalg.norm(normal, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = np.abs((normal * points).sum(-1)) / np.maximum(norms, 1e-12)
    return np.asarray(cosine < 0.17)


def _rims(depth_m: Image, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mark most pixels beside a depth discontinuity: the shadow of the projector."""
    jump = maximum_filter(depth_m, 3) - minimum_filter(depth_m, 3) > 0.06 * depth_m
    return np.asarray(jump & (rng.random(depth_m.shape) < 0.8))


def _patches(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mark a few random patches and single pixels, about 1.5 % of the image."""
    height, width = shape
    coarse = rng.random((height // 8 + 2, width // 8 + 2)).astype(np.float32)
    clouds = zoom(coarse, 8, order=1)[:height, :width]
    return np.asarray((clouds > 0.93) | (rng.random(shape) < 0.004))
