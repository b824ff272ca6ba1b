"""Convert colour to gray, and compute its gradient."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel
from torch import Tensor

from sigmasplat.native import kernels

Image = NDArray[np.float32]
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def gray_of(color: Image) -> Image:
    """Return the luma [H, W] of colour [H, W, 3]."""
    core = kernels()
    if core is None or color.dtype != np.float32 or not color.flags.c_contiguous:
        return np.asarray(color @ LUMA)
    gray = np.empty(color.shape[:-1], np.float32)
    core.gray(color, LUMA.tolist(), gray)
    return gray


def luma(color: Tensor) -> Tensor:
    """Return the luma [H, W] of colour planes [3, H, W], on their device."""
    red, green, blue = map(float, LUMA)
    gray: Tensor = red * color[0] + green * color[1] + blue * color[2]
    return gray


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
