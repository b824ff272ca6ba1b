"""Reduce colour to gray."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel
from torch import Tensor

Image = NDArray[np.float32]
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def gray_of(color: Image) -> Image:
    """Reduce colour [H, W, 3] to luma [H, W]."""
    return np.asarray(color @ LUMA)


def luma(color: Tensor) -> Tensor:
    """Reduce colour planes [3, H, W] to luma [H, W], on their device."""
    red, green, blue = map(float, LUMA)
    gray: Tensor = red * color[0] + green * color[1] + blue * color[2]
    return gray


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
