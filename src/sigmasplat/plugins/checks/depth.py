"""Check depth: whether it is registered to colour.

If colour and depth come from one camera, an outline in depth lies on an edge of the image. Outlines are scaled and
shifted by many trial values. If another scale or shift fits clearly better than none, depth is not registered.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import fft, ndimage

from sigmasplat.api import Frame

Plane = NDArray[np.float32]

WIDTH, REACH_PX = 320, 20
"""Image width, pixels, at which edges are compared; largest trial shift in each direction, pixels at that width."""
MAGNIFICATIONS = np.round(np.arange(-0.2, 0.2001, 0.02), 2)
"""Trial magnifications of depth about the image centre, for cameras with another focal length."""
MIN_DEVIATIONS, MIN_SCORE = 5.0, 0.5
"""The best trial must be above the median of all trials by this many robust standard deviations. Below this score,
colour and depth are taken to come from two cameras."""


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
    size = [fft.next_fast_len(n, real=True) for n in padded.shape]
    spectrum, reach, sums = fft.rfft2(padded, size), 2 * REACH_PX + 1, []
    for magnification in MAGNIFICATIONS:
        column = np.rint((x - width / 2) * (1 + magnification) + width / 2).astype(np.intp)
        row = np.rint((y - height / 2) * (1 + magnification) + height / 2).astype(np.intp)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        moved = np.bincount(row[inside] * width + column[inside], minlength=height * width).reshape(height, width)
        product = spectrum * fft.rfft2(moved.astype(np.float32), size).conj()
        sums.append(fft.irfft2(product, size)[:reach, :reach])
    return np.stack(sums).astype(np.float64)


def overlay(frame: Frame) -> NDArray[np.uint8]:
    """Return the image [H, W, 3], `WIDTH` pixels wide, with the outlines in depth drawn on it."""
    small = frame.resized(WIDTH, round(frame.camera.height * WIDTH / frame.camera.width))
    picture = (small.color * 255.0).round().astype(np.uint8)
    faint = np.asarray(Image.fromarray(picture).convert("L").convert("RGB"), np.uint8) // 2 + 64
    faint[ndimage.binary_dilation(outlines(small.depth_m))] = (255, 96, 32)
    return faint
