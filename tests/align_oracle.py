"""Oracle shared by tests of alignment: normal equations in float64, of residuals differentiated numerically."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera

Array = NDArray[np.float64]
CAMERA = Camera(53, 41, 45.0, 47.0, 24.6, 21.3)
CELLS = [np.s_[y : y + 16, x : x + 16] for y in range(0, CAMERA.height, 16) for x in range(0, CAMERA.width, 16)]
HUGE = 1e6
MOTION = se3.exp(np.array([0.011, -0.017, 0.013, 0.012, -0.009, 0.015]))


@dataclass
class Pair:
    """Two images of a wavy surface, and what one step is told about them."""

    gray: Array
    depth: Array
    weight: Array
    weight_depth: Array
    live_gray: Array
    live_depth: Array
    T: Array
    huber_gray: float
    huber_depth: float
    colors: float = 0.4
    depths: float = 0.6
    gate: float = 0.5
    gain: float = 1.0


def waves(seed: int, size: float, level: float) -> Array:
    """Draw an image of a few slow sines, exact in float32."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    a = sum(np.sin(rng.uniform(-0.25, 0.25) * u + rng.uniform(-0.25, 0.25) * v + rng.uniform(0, 6)) for _ in range(4))
    return (level + size * a).astype(np.float32).astype(float)


def pair(huber_gray: float = HUGE, huber_depth: float = HUGE, holes: bool = False) -> Pair:
    depth, live_depth, weights = waves(2, 0.01, 2.0), waves(4, 0.01, 2.02), (waves(5, 0.1, 1.0), waves(6, 0.1, 1.0))
    if holes:
        rng = np.random.default_rng(6)
        depth[rng.random(depth.shape) < 0.2] = 0.0
        live_depth[rng.random(depth.shape) < 0.05] = 0.0
        live_depth[12:20, 30:42] = 0.0  # a hole wider than a pixel and its neighbours
        live_depth[30:, 40:] += 1.0  # a step, and readings beyond the gate
        depth[5:9, 5:20] -= 0.7
    return Pair(waves(1, 0.1, 0.5), depth, *weights, waves(3, 0.1, 0.5), live_depth, MOTION, huber_gray, huber_depth)


MISSING = (0.25, 0.5, 0.75)


def missing(p: Pair, share: float) -> Pair:
    """Remove a share of the depth readings of both images at random."""
    rng = np.random.default_rng(round(100 * share))
    depths = (np.where(rng.random(depth.shape) < share, 0.0, depth) for depth in (p.depth, p.live_depth))
    return replace(p, **dict(zip(("depth", "live_depth"), depths, strict=True)))


def bilinear(image: Array, uv: Array) -> Array:
    return np.asarray(map_coordinates(image, uv[::-1], order=1, mode="nearest"))


CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
"""The four neighbours of a point between pixels, (x, y)."""


def neighbours(image: Array, uv: Array) -> Array:
    """Return the four pixels around each point [4, N]; points outside are moved to the border."""
    most = np.array([[CAMERA.width - 2], [CAMERA.height - 2]])
    x, y = np.clip(np.floor(uv).astype(int), 0, most)
    return np.stack([image[y + b, x + a] for a, b in CORNERS])


def between_readings(image: Array, uv: Array) -> Array:
    """Interpolate depth [N]: bilinear between four readings, else on the plane of least slope through the readings."""
    cells, value, inner = neighbours(image, uv), bilinear(image, uv), (uv - np.floor(uv)).T
    for pattern in itertools.product([False, True], repeat=4):
        here, read = (pattern == (cells > 0).T).all(1), np.array(pattern)
        if not read.any() or read.all():
            continue
        middle, mean = CORNERS[read].mean(0), cells[read][:, here].mean(0)
        slope = np.linalg.pinv(CORNERS[read] - middle) @ cells[read][:, here]
        if read.sum() == 2 and read[0] == read[3]:  # two readings on a diagonal determine no derivative
            slope *= 0
        value[here] = mean + ((inner[here] - middle) * slope.T).sum(1)
    return value


def warped(p: Pair, T: Array) -> tuple[Array, Array, Array, Array]:
    """Return pixels [2, N], z [N], gray and depth residuals [N] of every reference pixel, seen or not."""
    x, y, z = T[:3, :3] @ (CAMERA.rays().reshape(-1, 3) * p.depth.reshape(-1, 1)).T + T[:3, 3:]
    uv = np.stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy])
    return uv, z, p.gain * bilinear(p.live_gray, uv) - p.gray.ravel(), between_readings(p.live_depth, uv) - z


def oracle(p: Pair) -> tuple[Array, Array, Array, Array]:
    """Compute H, b, sums and grays in float64: weights and masks at p.T, derivatives by central differences."""
    uv, z, r_gray, r_depth = warped(p, p.T)
    inside = (uv >= 0).all(0) & (uv[0] < CAMERA.width - 1) & (uv[1] < CAMERA.height - 1) & (p.depth.ravel() > 0)
    cells = neighbours(p.live_depth, uv)
    read = inside & (cells.max(0) > 0)
    agrees = read & (np.abs(r_depth) < p.gate)
    steps = cells.max(0) - np.where(cells > 0, cells, np.inf).min(0)
    smooth = agrees & ((cells > 0).sum(0) > 2) & (steps < 0.03 * z)
    colored = inside & (agrees | ~read)
    width = p.huber_depth * z**2
    w_gray = colored * p.weight.ravel() * p.colors / p.huber_gray**2 * np.minimum(1, p.huber_gray / np.abs(r_gray))
    w_depth = smooth * p.weight_depth.ravel() * p.depths / width**2 * np.minimum(1, width / np.abs(r_depth))
    J = []
    for e in 1e-6 * np.eye(6):
        ahead, behind = warped(p, se3.exp(e) @ p.T), warped(p, se3.exp(-e) @ p.T)
        J.append([(ahead[k] - behind[k]) / 2e-6 for k in (2, 3)])
    Jg, Jd = (np.stack([row[k] for row in J]) for k in (0, 1))
    cost = (w_gray * r_gray**2 + w_depth * r_depth**2).sum()
    in_cells = np.array([[mask.reshape(p.depth.shape)[c].sum() for c in CELLS] for mask in (inside, read)])
    common = np.minimum(in_cells[0], 4 * in_cells[1]).sum()
    sums = np.array([cost, colored.sum(), read.sum(), agrees.sum(), common])
    grays = np.array([w_gray @ (r_gray + p.gray.ravel()) / p.gain, w_gray @ p.gray.ravel()])
    return (Jg * w_gray) @ Jg.T + (Jd * w_depth) @ Jd.T, (Jg * w_gray) @ r_gray + (Jd * w_depth) @ r_depth, sums, grays
