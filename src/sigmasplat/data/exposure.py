"""The exposure of an image relative to the map: a gain and an offset for each colour channel.

recorded colour = gain · colour of the map + offset. An exposure is an array [3, 2]: (gain, offset) of each channel.
"""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.types import Matrix

Floats = NDArray[np.float32]

NEUTRAL: Matrix = np.array([[1.0, 0.0]] * 3)
"""The exposure of an image whose colours are those of the map."""


def gray_exposure(a: float, b: float) -> Matrix:
    """Return the exposure exp(a) · colour + b, the same for each channel, as tracking fits it."""
    return np.array([[np.exp(a), b]] * 3)


def exposed(color: Floats, exposure: Matrix) -> Floats:
    """Return colours [..., 3] of the map, in [0, 1], as an image with this exposure records them."""
    gain, offset = exposure.astype(np.float32).T
    return np.asarray(np.clip(color * gain + offset, 0.0, 1.0), np.float32)


def unexposed(color: Floats, exposure: Matrix) -> Floats:
    """Return recorded colours [..., 3], in [0, 1], in the exposure of the map."""
    gain, offset = exposure.astype(np.float32).T
    return np.asarray(np.clip((color - offset) / gain, 0.0, 1.0), np.float32)


def between(frames: NDArray[np.integer], exposures: Matrix, at: NDArray[np.integer]) -> Matrix:
    """Return the exposures [M, 3, 2] at frame numbers `at` [M], interpolated between those of `frames` [K], which must
    ascend; before the first and after the last frame theirs are used. exposures [K, 3, 2]; neutral without frames."""
    if not len(frames):
        return np.tile(NEUTRAL, (len(at), 1, 1))
    columns = [np.interp(at, frames, column) for column in exposures.reshape(len(frames), 6).T]
    return np.stack(columns, -1).reshape(-1, 3, 2)


def centred(exposures: Matrix) -> Matrix:
    """Return exposures [K, 3, 2] relative to their mean: the geometric mean of the gains, the mean of the offsets.

    Only differences between images can be observed; without a fixed mean, the map's colours would drift.
    """
    gain, offset = np.exp(np.log(exposures[..., 0]).mean(0)), exposures[..., 1].mean(0)
    relative = exposures[..., 0] / gain
    return np.stack([relative, exposures[..., 1] - relative * offset], -1)
