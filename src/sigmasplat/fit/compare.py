"""Compare two RGB-D images at a given motion: does the depth of one lie on the surface of the other?

Alignment minimises residuals, so its own cost cannot tell a wrong minimum from a right one. This comparison is made
afterwards, with the noise of the sensor as its unit. It also separates the two signs of a depth difference: an object
in front may be new, but seeing through a known surface contradicts the pose.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.fit.pyramid import HIDDEN_M, NOISE_PER_M, Pyramid
from sigmasplat.native import kernels
from sigmasplat.types import Matrix

LEVEL = 0
"""Pyramid level that is compared: coarser ones have no depth where the sensor is noisy."""
STEP = 4
"""Every fourth row and column of that level is compared."""
NOISE_M = 0.002
"""Standard deviation of a depth reading at a distance of 0; a share of z² is added (`Pyramid.noise_per_m`)."""
CLOSE_SIGMA, CLOSE_M = 3.0, 0.02
"""Two surfaces are the same if they are closer than this many standard deviations plus a tolerance for the pose."""
LEAST_PIXELS = 50
FLAT = 0.01
"""A gray image with a smaller standard deviation (0 to 1) has no texture to compare."""


@dataclass(frozen=True)
class Comparison:
    """How well two images agree at a motion.

    common: share of the reference's readings that fall on a live reading; close, front, behind: shares of these whose
    live surface is the same, nearer, or farther. Of those that are not in front: residual, the median |depth
    difference| in standard deviations of a reading; correlation of the gray values, −1 to 1, NaN if one image is flat.
    points: the number of compared pixels; covered: their number relative to that of the live readings, at most 1.
    """

    common: float
    close: float
    front: float
    behind: float
    residual: float
    correlation: float
    points: int = 0
    covered: float = 1.0


NOTHING = Comparison(0.0, 0.0, 0.0, 0.0, float("inf"), float("nan"))


def compare(reference: Pyramid, live: Pyramid, T_live_reference: Matrix) -> Comparison:
    """Compare two images at T_live_reference [4, 4]; `NOTHING` if they have less than 50 compared pixels in common.

    Points of the reference that fall on live pixels of depth `HIDDEN_M` are left out.
    """
    core = kernels()
    if core is None:
        return compare_in_numpy(reference, live, T_live_reference)
    level = min(LEVEL, len(reference.cameras) - 1)
    host, c, found = reference.kernels.to_host, reference.cameras[level], np.empty(8)
    images = [host(plane[level]) for plane in (reference.depth, reference.gray, live.depth, live.gray)]
    T = np.ascontiguousarray(T_live_reference, np.float64)
    if not core.compare(
        *images, [c.fx, c.fy, c.cx, c.cy], T, _rules(HIDDEN_M, live.noise_per_m, live.scene_scale), found
    ):
        return NOTHING
    common, close, front, behind, residual, correlation, points, covered = found.tolist()
    return Comparison(common, close, front, behind, residual, correlation, int(points), covered)


def compare_in_numpy(reference: Pyramid, live: Pyramid, T_live_reference: Matrix) -> Comparison:
    """Return what `compare` returns, but for rounding, also where the kernels are not built."""
    level = min(LEVEL, len(reference.cameras) - 1)
    host, camera = reference.kernels.to_host, reference.cameras[level]
    depth, gray = (host(plane)[::STEP, ::STEP] for plane in (reference.depth[level], reference.gray[level]))
    v, u = np.nonzero(depth > 0)
    if len(u) < LEAST_PIXELS:
        return NOTHING
    z = depth[v, u].astype(np.float64)
    rays = np.stack([(STEP * u - camera.cx) / camera.fx, (STEP * v - camera.cy) / camera.fy, np.ones(len(u))])
    x, y, seen = T_live_reference[:3, :3] @ (rays * z) + T_live_reference[:3, 3:]
    ahead = np.maximum(seen, 1e-3)
    column, row = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
    inside = (seen > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width - 1) & (row < camera.height - 1)
    if inside.sum() < LEAST_PIXELS:
        return NOTHING
    left, top, seen = column[inside].astype(np.intp), row[inside].astype(np.intp), seen[inside]
    live_depth = host(live.depth[level])
    hidden = live_depth >= HIDDEN_M
    live_depth = np.where(hidden, np.float32(0.0), live_depth)
    other, difference = _nearest_surface(live_depth, left, top, seen)
    count, comparable = int(other.sum()), len(u) - int((hidden[top, left] & ~other).sum())
    if count < LEAST_PIXELS:
        return NOTHING
    difference, noise = difference[other], noise_m(seen[other], live.noise_per_m, live.scene_scale)
    noise = noise * noise_scale_in_numpy(live_depth, live.noise_per_m, live.scene_scale)
    limit = CLOSE_SIGMA * noise + CLOSE_M * live.scene_scale
    covered = min(1.0, count / max(int(np.count_nonzero(live_depth[::STEP, ::STEP])), 1))
    front = difference <= -limit
    close, behind = (float(np.mean(found)) for found in (np.abs(difference) < limit, difference >= limit))
    common, before = count / comparable, float(np.mean(front))
    if count - front.sum() < LEAST_PIXELS:
        return Comparison(common, close, before, behind, float("inf"), float("nan"), count, covered)
    residual = float(np.median(np.abs(difference)[~front] / noise[~front]))
    right, below = column[inside] - left > 0.5, row[inside] - top > 0.5
    live_gray = host(live.gray[level])[top + below, left + right]
    correlation = _correlation(gray[v, u][inside][other][~front], live_gray[other][~front])
    return Comparison(common, close, before, behind, residual, correlation, count, covered)


def noise_m(depth_m: Matrix, noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0) -> Matrix:
    """Return the standard deviation assumed for depth readings, metres; its constant grows with the scene."""
    return np.asarray(noise_per_m * depth_m**2 + NOISE_M * scene_scale)


def noise_scale(depth: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0) -> float:
    """Return the factor, at least 1, by which a depth image [h, w] is noisier than assumed.

    It is measured by the difference of each reading from the mean of its two neighbours in the row. Without noise, this
    difference is nearly 0 on smooth surfaces.
    """
    core = kernels()
    if core is None:
        return noise_scale_in_numpy(depth, noise_per_m, scene_scale)
    scale: float = core.noise_scale(np.ascontiguousarray(depth), _rules(float("inf"), noise_per_m, scene_scale))
    return scale


def noise_scale_in_numpy(
    depth: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0
) -> float:
    """Return the same value as `noise_scale`, also where the kernels are not built."""
    rows = depth[::STEP]
    width = (rows.shape[1] - 2) // STEP * STEP
    left, middle, right = (rows[:, i : i + width : STEP] for i in range(3))
    read = (left > 0) & (middle > 0) & (right > 0)
    if read.sum() < LEAST_PIXELS:
        return 1.0
    noise = noise_m(middle[read].astype(np.float64), noise_per_m, scene_scale)
    bend = np.abs(middle[read] - 0.5 * (left[read] + right[read])) / noise
    # For normal noise the bend has 1.22 standard deviations, and the median of its absolute value is 0.67 of these.
    return max(1.0, float(np.median(bend)) / (1.2247 * 0.6745))


def _rules(hidden_m: float, noise_per_m: float, scene_scale: float) -> list[float]:
    """Return the constants of a comparison in the order of the kernels; readings from hidden_m on are left out."""
    metres = NOISE_M * scene_scale, CLOSE_M * scene_scale
    return [STEP, LEAST_PIXELS, noise_per_m, metres[0], CLOSE_SIGMA, metres[1], FLAT, hidden_m]


def _nearest_surface(
    depth: NDArray[np.float32], left: NDArray[np.intp], top: NDArray[np.intp], expected_m: Matrix
) -> tuple[NDArray[np.bool_], Matrix]:
    """Return which points fall on a reading, and the difference to the one of the four neighbours that is closest to
    the expected depth: at a depth step either surface may be the right one."""
    best = np.full(len(left), np.inf)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        reading = depth[top + down, left + across]
        difference = np.where(reading > 0, reading - expected_m, np.inf)
        best = np.where(np.abs(difference) < np.abs(best), difference, best)
    return np.isfinite(best), best


def _correlation(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    a, b = one - one.mean(dtype=np.float64), other - other.mean(dtype=np.float64)
    norms = float(np.sqrt(np.mean(a * a))), float(np.sqrt(np.mean(b * b)))
    return float(np.mean(a * b)) / (norms[0] * norms[1]) if min(norms) > FLAT else float("nan")
