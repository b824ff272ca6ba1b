"""Hold depth's outlines against the image's edges: do colour and depth come from one camera?"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, signal

from sigmasplat.model.frame import Frame

Plane = NDArray[np.float32]

WIDTH = 320
"""Pixels across at which edges are compared."""
REACH_PX = 20
"""Shifts tried, either way, at that width."""
MAGNIFICATIONS = np.round(np.arange(-0.2, 0.2001, 0.02), 2)
"""… and magnifications of depth about the image's centre: cameras of other focal length."""
SURE = 5.0
"""Robust deviations by which the best place must stand out from all that were tried."""
AGREED = 0.5
"""Below this score, colour and depth are taken to be of two cameras."""


@dataclass(frozen=True)
class EdgeAgreement:
    """How well depth's outlines lie on the image's edges.

    score: edge strength under the outlines as they are, over that at the best magnification and shift; 1 = nothing fits
    better. deviations: how far the best stands out; below `SURE` nothing can be said. magnification, shift_px [2]: what
    would bring depth onto colour, pixels of the full image; outlines: their number.
    """

    score: float
    deviations: float
    magnification: float
    shift_px: tuple[float, float]
    outlines: int

    @property
    def known(self) -> bool:
        """Tell whether there were edges enough to judge by."""
        return self.deviations >= SURE

    @property
    def registered(self) -> bool:
        """Tell whether colour and depth fit each other, as far as known."""
        return not self.known or self.score >= AGREED

    def sentence(self) -> str:
        """Say it in words."""
        if not self.known:
            return "too few edges to judge"
        if self.registered:
            return f"{self.score:.2f} of 1: depth's outlines lie on the image's edges"
        x, y = self.shift_px
        return (
            f"{self.score:.2f} of 1: depth would fit the image if magnified by {self.magnification:+.0%} "
            f"and shifted by ({x:+.0f}, {y:+.0f}) pixels"
        )


def edge_agreement(frames: Iterable[Frame]) -> EdgeAgreement | None:
    """Compare edges and outlines over some frames of one sequence; None where there is no outline at all."""
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
    near = slice(REACH_PX - 1, REACH_PX + 2)  # resizing and the sensor's ragged edges cost up to a pixel
    here, there = float(surface[len(MAGNIFICATIONS) // 2, near, near].max()), float(surface.max())
    shift = (float(best[2] - REACH_PX) * scale, float(best[1] - REACH_PX) * scale)
    score = max(here - middle, 0.0) / (there - middle + 1e-9)
    return EdgeAgreement(score, (there - middle) / spread, float(MAGNIFICATIONS[best[0]]), shift, count)


def outlines(depth_m: Plane) -> NDArray[np.bool_]:
    """Find readings [H, W] next to something at least 8 % farther; holes count as what lies farthest about them.

    A Kinect's shadow, without reading, lies on the background's side, so its far border is no outline.
    """
    filled = np.where(depth_m > 0, depth_m, ndimage.maximum_filter(depth_m, size=9))
    return np.asarray((depth_m > 0) & (ndimage.maximum_filter(filled, size=3) > 1.08 * filled + 0.03))


def edges(color: Plane) -> Plane:
    """Return edge strength [H, W] of an image [H, W, 3]: gradient relative to its neighbourhood's, of mean 0."""
    gray = ndimage.gaussian_filter(255.0 * color.mean(-1), 0.7)
    gradient = np.hypot(ndimage.sobel(gray, 0), ndimage.sobel(gray, 1))
    strength = np.clip(gradient / (ndimage.gaussian_filter(gradient, 12.0) + 5.0), 0.0, 3.0)
    return np.asarray(strength - strength.mean(), np.float32)


def _correlations(strength: Plane, found: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Sum the edge strength under the outlines for every magnification and shift, [M, 2R + 1, 2R + 1]."""
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
    """Return the image [H, W, 3] at the width of the comparison, depth's outlines drawn in."""
    small = frame.resized(WIDTH, round(frame.camera.height * WIDTH / frame.camera.width))
    picture = (small.color * 255.0).round().astype(np.uint8)
    faint = np.asarray(Image.fromarray(picture).convert("L").convert("RGB"), np.uint8) // 2 + 64
    faint[ndimage.binary_dilation(outlines(small.depth_m))] = (255, 96, 32)
    return faint
