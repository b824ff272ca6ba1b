"""Spoil perfect images the way a structured-light sensor does."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter, zoom

from sigmasplat.model.camera import Camera

Image = NDArray[np.float32]

JITTER_PX = 0.6
RANGE_M = (0.35, 7.0)
COLOR_SIGMA = 0.008
DRIFT_KNOT_FRAMES = 300
"""The calibration is another one, by chance, each so many frames; between them it changes smoothly."""


def noise_sigma_m(depth_m: Image) -> Image:
    """Return the spread of a Kinect's reading at a depth, metres: 1.2 mm + 1.9 mm/m² (z − 0.4 m)² (Nguyen 2012)."""
    return (0.0012 + 0.0019 * (depth_m - 0.4) ** 2).astype(np.float32)


def measured_depth(depth_m: Image, camera: Camera, rng: np.random.Generator) -> Image:
    """Return what a sensor reads of true depth [H, W]: edges that wander, noise that grows with z², holes as 0.

    Holes: grazing surfaces, a rim along jumps in depth, random patches and speckles, and what is out of range.
    """
    seen = _jittered(depth_m, rng)
    noisy = seen + rng.standard_normal(seen.shape, np.float32) * noise_sigma_m(seen)
    in_range = (noisy > RANGE_M[0]) & (noisy < RANGE_M[1])
    blind = _grazing(depth_m, camera) | _rims(depth_m, rng) | _patches(depth_m.shape, rng)
    return np.where(in_range & ~blind, noisy, 0.0).astype(np.float32)


def drifted_depth(depth_m: Image, i: int, seed: int, deviation: float) -> Image:
    """Return true depth [H, W] as read at frame i by a sensor whose calibration wanders as it warms up.

    The relative error is a polynomial of second degree over the image: scale, tilts, bowl, saddle and twist, each a
    smooth random process over the frames, independent of the others; `deviation` is the standard deviation of them
    together, over image and time. It depends on seed and i alone, and is the same on equal surfaces seen soon after
    each other: poses agree from frame to frame and go astray together, as they do with a real sensor.
    """
    height, width = depth_m.shape
    v, u = np.linspace(-1.0, 1.0, height)[:, None], np.linspace(-1.0, 1.0, width)
    # Legendre's polynomials: each of mean square 1, orthogonal, so that their variances add up.
    one, tilt_u, tilt_v = np.ones((height, width)), np.sqrt(3.0) * u, np.sqrt(3.0) * v
    shapes = (one, tilt_u, tilt_v, tilt_u * tilt_v, *(np.sqrt(1.25) * (3.0 * x**2 - 1.0) for x in (u, v)))
    error = sum(_smooth_process(i, (seed, k, 8)) * shape for k, shape in enumerate(shapes)) / np.sqrt(len(shapes))
    return np.asarray(depth_m * (1.0 + deviation * error), np.float32)


def _smooth_process(i: int, seed: tuple[int, ...]) -> float:
    """Return a random process of mean 0 and variance 1 at frame i: a cubic spline between normal numbers."""
    knot, s = divmod(i / DRIFT_KNOT_FRAMES, 1.0)
    weights = np.array([(1 - s) ** 3, 3 * s**3 - 6 * s**2 + 4, -3 * s**3 + 3 * s**2 + 3 * s + 1, s**3])
    normals = [np.random.default_rng((*seed, int(knot) + k)).standard_normal() for k in range(4)]
    return float(weights @ normals / np.linalg.norm(weights))


def measured_color(color: Image, rng: np.random.Generator) -> Image:
    """Return colour [H, W, 3] with the noise of a small camera."""
    return np.clip(color + COLOR_SIGMA * rng.standard_normal(color.shape, np.float32), 0.0, 1.0)


def _jittered(depth_m: Image, rng: np.random.Generator) -> Image:
    """Read every pixel a fraction of a pixel off: silhouettes fray, surfaces hardly change."""
    v, u = np.indices(depth_m.shape, np.float32)
    offsets = rng.normal(0.0, JITTER_PX, (2, *depth_m.shape)).astype(np.float32)
    return np.asarray(map_coordinates(depth_m, [v + offsets[0], u + offsets[1]], order=0, mode="nearest"))


def _grazing(depth_m: Image, camera: Camera) -> NDArray[np.bool_]:
    """Find surfaces seen at less than about 10°: the light pattern is stretched past recognition."""
    points = camera.rays() * depth_m[..., None]
    along_v, along_u = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normal = np.cross(along_u, along_v)
    norms = np.linalg.norm(normal, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = np.abs((normal * points).sum(-1)) / np.maximum(norms, 1e-12)
    return np.asarray(cosine < 0.17)


def _rims(depth_m: Image, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Find most pixels beside a jump in depth: the projector's shadow."""
    jump = maximum_filter(depth_m, 3) - minimum_filter(depth_m, 3) > 0.06 * depth_m
    return np.asarray(jump & (rng.random(depth_m.shape) < 0.8))


def _patches(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Find a few random patches and single speckles, about 1.5 % of the image."""
    height, width = shape
    coarse = rng.random((height // 8 + 2, width // 8 + 2)).astype(np.float32)
    clouds = zoom(coarse, 8, order=1)[:height, :width]
    return np.asarray((clouds > 0.93) | (rng.random(shape) < 0.004))
