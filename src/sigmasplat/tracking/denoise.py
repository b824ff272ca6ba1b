"""Smooth depth images that are noisier than those of a structured-light sensor."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.env import opencv
from sigmasplat.fit.compare import noise_scale
from sigmasplat.fit.pyramid import NOISE_PER_M

DIAMETER_PX = 5
"""Each reading becomes the weighted mean of the readings in a window of this width."""
SPREAD_PX, SPREAD_SIGMA = 2.0, 3.0
"""Spread of the weights: with the distance in pixels, and with the difference of the readings in standard deviations of
a reading, so that depth steps stay sharp."""
HOLE = -1.0
"""Inverse depth, 1/m, of a pixel without a reading: so far from all readings that its weight is 0."""


def denoised(
    depth_m: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0
) -> NDArray[np.float32]:
    """Return depth [H, W] m, 0 = no reading, smoothed by a bilateral filter if its noise is above that of the sensor
    model (`noise_scale`); otherwise the same image. Holes stay holes.

    The filter works on inverse depth (Tomasi & Manduchi 1998): noise that grows with z² is constant there.
    """
    scale = noise_scale(depth_m, noise_per_m, scene_scale)
    if scale <= 1.0:
        return depth_m
    read = depth_m > 0
    inverse = np.where(read, 1.0 / np.maximum(depth_m, np.float32(1e-3)), np.float32(HOLE)).astype(np.float32)
    smooth = opencv().bilateralFilter(inverse, DIAMETER_PX, SPREAD_SIGMA * scale * noise_per_m, SPREAD_PX)
    return np.where(read, 1.0 / np.maximum(smooth, np.float32(1e-3)), np.float32(0.0)).astype(np.float32)
