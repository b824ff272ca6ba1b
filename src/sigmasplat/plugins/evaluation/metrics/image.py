"""Score a rendered image against the recorded one: PSNR, SSIM, MS-SSIM, depth L1. A mask leaves pixels out."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from sigmasplat.api import SigmaSplatError

Pixels = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Factors = tuple[NDArray[np.float64], NDArray[np.float64]]

WINDOW_RADIUS = 5
WINDOW_SIGMA = 1.5
SSIM_LEAST_PX = 2 * WINDOW_RADIUS + 1
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the five scales of MS-SSIM, from the full size to 1/16 (Wang et al. 2003)."""
MS_SSIM_LEAST_PX = 2 * WINDOW_RADIUS * 2 ** (len(SCALE_WEIGHTS) - 1) + 1
"""At the smallest scale a window must fit into the image."""


def psnr(rendered: Pixels, recorded: Pixels, valid: Mask | None = None) -> float:
    """Return the peak signal-to-noise ratio, dB, of colours [H, W, 3] in [0, 1] on the pixels of `valid` [H, W].

    inf if both images are equal, nan if no pixel is valid.
    """
    squared = (rendered.astype(np.float64) - recorded) ** 2
    if valid is not None:
        squared = squared[valid]
    if not squared.size:
        return float("nan")
    mse = float(squared.mean())
    return float("inf") if mse == 0.0 else -10.0 * float(np.log10(mse))


def ssim(rendered: Pixels, recorded: Pixels, valid: Mask | None = None, factors: Factors | None = None) -> float:
    """Return the structural similarity of colours [H, W, 3] in [0, 1] (Wang et al. 2004, eq. 13).

    Gaussian window 11×11, σ 1.5, C1 = 0.01², C2 = 0.03². Only windows inside the image count. The result is the mean
    over channels and over the windows whose centre is in `valid` [H, W]; nan if no window is left. `factors`: what
    `similarity_factors` returns, if it is known.
    Raises SigmaSplatError if the image is smaller than a window.
    """
    if min(rendered.shape[:2]) < SSIM_LEAST_PX:
        height, width = rendered.shape[:2]
        raise SigmaSplatError(f"SSIM needs an image of at least 11×11 pixels, found {width}×{height}")
    luminance, contrast = factors or similarity_factors(rendered, recorded)
    similarity = luminance * contrast
    if valid is None:
        return float(similarity.mean())
    inner = valid[WINDOW_RADIUS:-WINDOW_RADIUS, WINDOW_RADIUS:-WINDOW_RADIUS]
    return float(similarity[inner].mean()) if inner.any() else float("nan")


def similarity_factors(rendered: Pixels, recorded: Pixels) -> Factors:
    """Return the two factors of SSIM for every window [H − 10, W − 10, 3], indexed by its centre minus 5 pixels:
    luminance, and contrast times structure."""
    return _similarities(rendered.astype(np.float64), recorded.astype(np.float64))


def ms_ssim(rendered: Pixels, recorded: Pixels, factors: Factors | None = None) -> float:
    """Return the structural similarity over five scales of colours [H, W, 3] in [0, 1] (Wang et al. 2003, eq. 7).

    This is the definition of pytorch-msssim: windows as in `ssim`; 2×2 means from scale to scale, with a row or column
    of zeros in front of an odd size; negative means count as 0. All pixels count: blocks of other pixels would enter
    the small scales. nan if a side has fewer than `MS_SSIM_LEAST_PX` = 161 pixels. `factors`: as in `ssim`.
    """
    if min(rendered.shape[:2]) < MS_SSIM_LEAST_PX:
        return float("nan")
    x, y = rendered.astype(np.float64), recorded.astype(np.float64)
    product = np.ones(x.shape[2])
    for scale, weight in enumerate(SCALE_WEIGHTS, 1):
        luminance, contrast = factors if factors and scale == 1 else _similarities(x, y)
        similarity = contrast if scale < len(SCALE_WEIGHTS) else luminance * contrast
        product *= np.maximum(similarity.mean((0, 1)), 0.0) ** weight
        x, y = _half_size(x), _half_size(y)
    return float(product.mean())


def _half_size(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average blocks of 2×2 pixels; zeros are put in front of an odd size."""
    height, width, channels = image.shape
    even = np.pad(image, ((height % 2, 0), (width % 2, 0), (0, 0)))
    return np.asarray(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2, channels).mean((1, 3)))


def _similarities(x: NDArray[np.float64], y: NDArray[np.float64]) -> Factors:
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return luminance, (2 * covariance + c2) / (variance_x + variance_y + c2)


def _window_mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average over the Gaussian window, keeping only windows inside the image."""
    offsets = np.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
    weights = np.exp(-0.5 * (offsets / WINDOW_SIGMA) ** 2)
    weights /= weights.sum()
    smooth = correlate1d(correlate1d(image, weights, axis=0), weights, axis=1)
    inside = slice(WINDOW_RADIUS, -WINDOW_RADIUS)
    return np.asarray(smooth[inside, inside])


def depth_l1(rendered_m: Pixels, recorded_m: Pixels, valid: Mask | None = None) -> float:
    """Return the mean absolute depth error, metres, of [H, W] maps where both have a reading (> 0) and `valid` is true.

    nan if no pixel is left.
    """
    both = (rendered_m > 0) & (recorded_m > 0)
    if valid is not None:
        both &= valid
    if not both.any():
        return float("nan")
    return float(np.abs(rendered_m[both].astype(np.float64) - recorded_m[both]).mean())
