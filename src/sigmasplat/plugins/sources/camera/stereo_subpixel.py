"""Refine disparities below a pixel: semi-global matching prefers some fractions of a pixel, by up to 0.2 px."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.opencv import opencv

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

REACH_PX, SPREAD_PX = 5, 3.3
"""The window: its half edge, and the standard deviation of its Gaussian weights."""
SMOOTH_PX = 0.7
"""Standard deviation of the smoothing of both images: their noise, and less aliasing in the gradient."""
STEPS = 2
FAR_OFF = 10.0
"""A pixel whose gray values differ by this much counts half (of 255; Geman–McClure)."""
FLAT = 4.0
"""Prior of no slope: like this much squared gradient one pixel from the centre of the window."""
PRIOR = 1.0
"""Weight of the disparity that matching found, as squared gradient in gray values per pixel."""
LARGEST_PX = 1.0
"""Largest change of a disparity."""


@dataclass(frozen=True, eq=False)
class Subpixel:
    """disparity: refined, px [H, W]; texture: root of the squared gradients that decide it, gray values per pixel;
    residual: root mean square difference of the images in the window, gray values."""

    disparity: Floats
    texture: Floats
    residual: Floats


def refine(left: Bytes, right: Bytes, disparity: Floats, smooth: NDArray[np.bool_]) -> Subpixel:
    """Fit a plane of disparity to the window around each pixel, so that the right image agrees with the left one.

    left, right: rectified gray images [H, W]; disparity: px [H, W]; smooth: pixels whose disparity is known and away
    from edges. Others keep their disparity and are not used. The mean difference of each window is left out, as two
    cameras differ in brightness (least squares, Lucas and Kanade 1981; weights of Geman and McClure 1985).
    """
    cv2 = opencv()
    a, b = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX) for image in (left, right))
    slope = cv2.Sobel(b, cv2.CV_32F, 1, 0, scale=1 / 8)
    rows, columns = np.indices(a.shape, np.float32)
    used, found, decided = smooth.astype(np.float32), disparity, np.zeros_like(disparity)
    count = _window(used) + np.float32(1e-6)

    def difference(at: Floats) -> Floats:
        there = cv2.remap(b, at, rows, cv2.INTER_CUBIC) - a
        return np.asarray(there - _window(used * there) / count, np.float32)

    for _ in range(STEPS):
        apart, gradient = difference(columns - found), cv2.remap(slope, columns - found, rows, cv2.INTER_LINEAR)
        weight = used / (1.0 + (apart / np.float32(FAR_OFF)) ** 2)
        planes, decided = _planes(weight, gradient, apart + gradient * found, disparity)
        near = np.clip(planes, disparity - np.float32(LARGEST_PX), disparity + np.float32(LARGEST_PX))
        found = np.where(smooth, near, disparity).astype(np.float32)
    residual = np.sqrt(_window(used * difference(columns - found) ** 2) / count)
    return Subpixel(found, np.sqrt(decided), residual)


def _planes(weight: Floats, gradient: Floats, wanted: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Solve Σ w (g·(d + p·x + q·y) − wanted)² for d at the centre of each window [H, W]; return it, and the squared
    gradients that decide it after p and q are chosen (Schur complement)."""
    square, target = weight * gradient * gradient, weight * gradient * wanted
    s, x, y = _window(square), _window(square, 1, 0), _window(square, 0, 1)
    xx, xy, yy = (_window(square, i, 2 - i) for i in (2, 1, 0))
    xx, yy = xx + np.float32(FLAT), yy + np.float32(FLAT)
    t, tx, ty = _window(target), _window(target, 1, 0), _window(target, 0, 1)
    determinant = xx * yy - xy * xy
    along_x, along_y = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant
    decided = np.maximum(s - along_x * x - along_y * y, 0.0)
    d = (t - along_x * tx - along_y * ty + np.float32(PRIOR) * prior) / (decided + np.float32(PRIOR))
    return np.asarray(d, np.float32), np.asarray(decided, np.float32)


def _window(image: Floats, powers_x: int = 0, powers_y: int = 0) -> Floats:
    """Return the weighted mean of image · x^powers_x · y^powers_y over the window around each pixel [H, W]."""
    cv2 = opencv()
    offset = np.arange(-REACH_PX, REACH_PX + 1, dtype=np.float32)
    gaussian = np.exp(-0.5 * (offset / SPREAD_PX) ** 2)
    gaussian /= gaussian.sum()
    along = [(gaussian * offset**power).astype(np.float32) for power in (powers_x, powers_y)]
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, *along, borderType=cv2.BORDER_CONSTANT), np.float32)
