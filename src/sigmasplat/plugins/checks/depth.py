"""Check depth: whether it is registered to colour, and how noisy it is.

If colour and depth come from one camera, an outline in depth lies on an edge of the image. Outlines are scaled and
shifted by many trial values. If another scale or shift fits clearly better than none, depth is not registered. Noise is
the residual of planes fitted to small patches, against their distance.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, signal
from scipy.optimize import nnls

from sigmasplat.api import NOISE_PER_M, Frame, SensorModel, sensor_model

Plane = NDArray[np.float32]

WIDTH = 320
"""Image width, pixels, at which edges are compared."""
REACH_PX = 20
"""Largest trial shift in each direction, pixels at that width."""
MAGNIFICATIONS = np.round(np.arange(-0.2, 0.2001, 0.02), 2)
"""Trial magnifications of depth about the image centre, for cameras with another focal length."""
MIN_DEVIATIONS = 5.0
"""The best trial must be above the median of all trials by this many robust standard deviations."""
MIN_SCORE = 0.5
"""Below this score, colour and depth are taken to come from two cameras."""


@dataclass(frozen=True)
class EdgeAgreement:
    """How well the outlines in depth agree with the edges of the image.

    score: edge strength under the outlines without a change, relative to the best trial; 1 = no trial fits better.
    deviations: how far the best trial is above the median, in robust standard deviations; below `MIN_DEVIATIONS` the
    result is unknown. magnification, shift_px [2]: the best trial, in pixels of the full image; outlines: number of
    outline pixels.
    """

    score: float
    deviations: float
    magnification: float
    shift_px: tuple[float, float]
    outlines: int

    @property
    def known(self) -> bool:
        """Return whether there are enough edges for a result."""
        return self.deviations >= MIN_DEVIATIONS

    @property
    def registered(self) -> bool:
        """Return whether colour and depth agree; True if unknown."""
        return not self.known or self.score >= MIN_SCORE

    def sentence(self) -> str:
        """Describe the result in words."""
        if not self.known:
            return "unknown: too few edges"
        if self.registered:
            return f"{self.score:.2f} of 1: depth outlines match image edges"
        x, y = self.shift_px
        return (
            f"{self.score:.2f} of 1: depth matches the image if magnified by {self.magnification:+.0%} "
            f"and shifted by ({x:+.0f}, {y:+.0f}) pixels"
        )


def edge_agreement(frames: Iterable[Frame]) -> EdgeAgreement | None:
    """Compare edges and outlines over some frames of one recording; None without any outline."""
    surface, count, scale = np.zeros((len(MAGNIFICATIONS), 2 * REACH_PX + 1, 2 * REACH_PX + 1)), 0, 1.0
    for frame in frames:
        scale = frame.camera.width / WIDTH
        small = frame.resized(WIDTH, round(frame.camera.height / scale))
        found = outlines(small.depth_m)
        surface += _correlations(edges(small.color), found)
        count += int(found.sum())
    if not count:
        return None
    surface /= count
    middle = float(np.median(surface))
    spread = 1.4826 * float(np.median(np.abs(surface - middle))) + 1e-9
    best = np.unravel_index(surface.argmax(), surface.shape)
    near = slice(REACH_PX - 1, REACH_PX + 2)  # resizing and noisy depth edges cost up to a pixel
    unchanged, highest = float(surface[len(MAGNIFICATIONS) // 2, near, near].max()), float(surface.max())
    shift = (float(best[2] - REACH_PX) * scale, float(best[1] - REACH_PX) * scale)
    score = max(unchanged - middle, 0.0) / (highest - middle + 1e-9)
    return EdgeAgreement(score, (highest - middle) / spread, float(MAGNIFICATIONS[best[0]]), shift, count)


def outlines(depth_m: Plane) -> NDArray[np.bool_]:
    """Return the pixels [H, W] next to a pixel at least 8 % farther away. A hole gets the farthest depth around it.

    The shadow of a structured-light sensor such as Kinect is a hole on the background side of an edge. The far side of
    the hole is therefore not an outline.
    """
    filled = np.where(depth_m > 0, depth_m, ndimage.maximum_filter(depth_m, size=9))
    return np.asarray((depth_m > 0) & (ndimage.maximum_filter(filled, size=3) > 1.08 * filled + 0.03))


def edges(color: Plane) -> Plane:
    """Return the edge strength [H, W] of an image [H, W, 3]: gradient relative to its neighbourhood, with mean 0."""
    gray = ndimage.gaussian_filter(255.0 * color.mean(-1), 0.7)
    gradient = np.hypot(ndimage.sobel(gray, 0), ndimage.sobel(gray, 1))
    strength = np.clip(gradient / (ndimage.gaussian_filter(gradient, 12.0) + 5.0), 0.0, 3.0)
    return np.asarray(strength - strength.mean(), np.float32)


def _correlations(strength: Plane, found: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the sum of edge strength under the outlines for each magnification and shift, [M, 2R + 1, 2R + 1]."""
    height, width = strength.shape
    y, x = np.nonzero(found)
    padded = np.pad(strength, REACH_PX)
    sums = []
    for magnification in MAGNIFICATIONS:
        column = np.rint((x - width / 2) * (1 + magnification) + width / 2).astype(np.intp)
        row = np.rint((y - height / 2) * (1 + magnification) + height / 2).astype(np.intp)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        moved = np.bincount(row[inside] * width + column[inside], minlength=height * width).reshape(height, width)
        sums.append(signal.correlate(padded, moved.astype(np.float32), "valid", method="fft"))
    return np.stack(sums).astype(np.float64)


def overlay(frame: Frame) -> NDArray[np.uint8]:
    """Return the image [H, W, 3], `WIDTH` pixels wide, with the outlines in depth drawn on it."""
    small = frame.resized(WIDTH, round(frame.camera.height * WIDTH / frame.camera.width))
    picture = (small.color * 255.0).round().astype(np.uint8)
    faint = np.asarray(Image.fromarray(picture).convert("L").convert("RGB"), np.uint8) // 2 + 64
    faint[ndimage.binary_dilation(outlines(small.depth_m))] = (255, 96, 32)
    return faint


Floats = NDArray[np.float64]

PATCHES_ACROSS = 36
"""The width of a patch is this share of the image's, at least `LEAST_PX`: a sensor's noise is correlated over a few
pixels, so small patches would show too little of it."""
LEAST_PX = 7
SAME_SURFACE = 1.1
"""Patches with a larger ratio of depths contain a step."""
CURVED = 0.7
"""If a quadratic surface leaves less than this share of a plane's squared residuals, the patch is not flat."""
LEAST_COSINE = 0.5
"""Patches seen at more than 60° are left out: they are noisier."""
LEAST_PATCHES, BINS = 60, 12
SHOWN_M = (1.0, 2.0, 4.0)


@dataclass(frozen=True)
class SensorNoise:
    """The measured model, from how many patches, and their distances (5 % and 95 %)."""

    model: SensorModel
    patches: int
    range_m: tuple[float, float]

    def row(self, sensor: str) -> str:
        """Describe the noise beside that of the model in use (`input.sensor`)."""
        measured, used = (
            ", ".join(f"{1000 * std_at(model, z):.2g}" for z in SHOWN_M) + " mm"
            for model in (self.model, in_use(sensor))
        )
        return (
            f"{measured} at {', '.join(f'{z:g}' for z in SHOWN_M)} m, from {self.patches} flat patches at "
            f"{self.range_m[0]:.1f} to {self.range_m[1]:.1f} m; in use ({sensor}): {used}; measured model: "
            f"--set input.sensor={self.model}"
        )

    def record(self, sensor: str) -> dict[str, Any]:
        """Return the measurement as values for JSON."""
        return {
            "base_m": self.model.base, "z2_per_m": self.model.z2, "patches": self.patches, "range_m": self.range_m,
            "at_m": SHOWN_M, "std_m": [std_at(self.model, z) for z in SHOWN_M], "model": str(self.model),
            "in_use": {"sensor": sensor, "std_m": [std_at(in_use(sensor), z) for z in SHOWN_M]},
        }  # fmt: skip


def in_use(sensor: str) -> SensorModel:
    """Return the model that `input.sensor` names; for the generic law, that of structured light."""
    return sensor_model(sensor) or SensorModel(z2=NOISE_PER_M)


def std_at(model: SensorModel, z_m: float) -> float:
    """Return σ at a distance, m, without the factors of edges and angles."""
    return float(np.sqrt(model.base**2 + (model.z1 * z_m) ** 2 + (model.z2 * z_m * z_m) ** 2))


def measure_noise(frames: Sequence[Frame]) -> SensorNoise | None:
    """Fit σ² = base² + (z2·z²)² to the residuals of flat patches; None without enough of them.

    Patches are sorted by distance into bins of equal size; the median of a bin is robust to patches that are not flat.
    """
    found = [(np.zeros(0), np.zeros(0)), *(flat_patches(frame) for frame in frames)]
    z, std = (np.concatenate([values[k] for values in found]) for k in (0, 1))
    if len(z) < LEAST_PATCHES:
        return None
    bins = [part for part in np.array_split(np.argsort(z), BINS) if len(part)]
    at, square = (np.array([np.median(values[part]) for part in bins]) for values in (z, std * std))
    square = np.maximum(square, 1e-12)
    columns = np.stack([np.ones_like(at), at**4], 1) / square[:, None]  # relative errors
    (base2, z22), _ = nnls(columns, np.ones_like(at))
    low, high = np.percentile(z, (5, 95)).tolist()
    return SensorNoise(SensorModel(base=float(np.sqrt(base2)), z2=float(np.sqrt(z22))), len(z), (low, high))


def flat_patches(frame: Frame) -> tuple[Floats, Floats]:
    """Return the distance and the standard deviation of the residuals of each flat patch of a frame, m [P].

    The inverse depth of a plane is affine in the image, so the fit is linear.
    """
    camera, size = frame.camera, max(LEAST_PX, frame.camera.width // PATCHES_ACROSS // 2 * 2 + 1)
    if min(frame.depth_m.shape) < size:
        return np.zeros(0), np.zeros(0)
    windows = sliding_window_view(frame.depth_m, (size, size))[::size, ::size]
    patches = windows.reshape(-1, size * size).astype(np.float64)
    v, u = (size * index.ravel() + size // 2 for index in np.indices(windows.shape[:2]))
    whole = (patches.min(1) > 0) & (patches.max(1) < SAME_SURFACE * patches.min(1))
    patches, u, v = patches[whole], u[whole], v[whole]
    z, w = patches.mean(1), 1.0 / np.maximum(patches, 1e-9)
    across, down = (x.ravel() - size // 2 for x in np.meshgrid(np.arange(size), np.arange(size)))
    plane = np.stack([np.ones(size * size), across, down], 1)
    curved = np.concatenate([plane, np.stack([across**2, across * down, down**2], 1)], 1)
    fitted = w @ np.linalg.pinv(plane).T
    rest, least = (((w - w @ (np.linalg.pinv(A).T @ A.T)) ** 2).sum(1) for A in (plane, curved))
    normal = np.stack([
        camera.fx * fitted[:, 1], camera.fy * fitted[:, 2],
        fitted[:, 0] - fitted[:, 1] * (u - camera.cx) - fitted[:, 2] * (v - camera.cy),
    ])  # fmt: skip
    ray = np.sqrt(1.0 + ((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2)
    cosine = fitted[:, 0] / (ray * np.linalg.norm(normal, axis=0))
    flat = (least > CURVED * rest) & (cosine > LEAST_COSINE)
    return z[flat], (z * z * np.sqrt(rest / (size * size - 3)))[flat]
