"""Predicted depth: what is unknown in it is fitted, so that frames agree with each other and with the map.

A network's depth p has an arbitrary scale. The depth that is used is 1 / (s · f(u, v) / p + b): f is a smooth function
of the image position, the same for neighbouring frames (`depth_shape`); s and b are those of the frame.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.env import opencv
from sigmasplat.tracking.depth_shape import DepthShape

Floats = NDArray[np.float32]

CELL_PX = 8
"""s and b are fitted to the medians of cells of this width: the noise of pixels would bias a fit to inverse depth."""
LEAST_CELLS = 20
ROUNDS = 5
LEAST_SIGMA = 0.005
HUBER = 1.5
STIFF_SCALE, STIFF_SHIFT = 1.0, 10.0
"""Weight of s = 1 and of b = 0 against the cells. Without the first, small errors of the map would add up from keyframe
to keyframe."""
LEAST_INVERSE = 1e-3
"""Predicted surfaces farther than the inverse of this, m, have no depth."""
DIAMETER_PX, SPREAD_PX, SPREAD_SIGMA = 9, 3.0, 3.0
HOLE = -20.0
"""Logarithm of the depth of a pixel without depth: so far from all others that its weight is 0."""


@dataclass(frozen=True, eq=False)
class DepthFit:
    """What is known of the depth that a network predicts: its shape over the image, and s and b of the last frame."""

    shape: DepthShape = field(default_factory=DepthShape.unknown)
    scale: float = 1.0
    shift: float = 0.0

    def applied(self, predicted_m: Floats) -> Floats:
        """Return the depth [H, W] to use in the place of predicted depth; 0 stays 0."""
        shaped = self.shape.corrected(predicted_m)
        read = shaped > 0
        inverse = self.scale / np.where(read, shaped, np.float32(1.0)) + self.shift
        known = read & (inverse > LEAST_INVERSE)
        return np.where(known, 1.0 / np.where(known, inverse, 1.0), 0.0).astype(np.float32)

    def fitted(self, predicted_m: Floats, known_m: Floats) -> "DepthFit":
        """Return the fit with s and b of a frame, so that its depth agrees with the known depth [H, W], 0 = unknown;
        the same fit if too little is known."""
        shaped = self.shape.corrected(predicted_m)
        both = (shaped > 0) & (known_m > 0)
        found, known = _medians(shaped, both), _medians(known_m, both)
        used = (found > 0) & (known > 0)
        if used.sum() < LEAST_CELLS:
            return self
        z = known[used]
        middle = float(np.median(z))
        A = np.stack([z / found[used], z / middle], 1)
        stiff, goal = np.diag([STIFF_SCALE, STIFF_SHIFT]), np.array([1.0, 0.0])
        x = np.array([1.0 / float(np.median(1.0 / A[:, 0])), 0.0])
        for _ in range(ROUNDS):
            error = np.abs(A @ x - 1.0)
            sigma = max(1.4826 * float(np.median(error)), LEAST_SIGMA)
            weight = 1.0 / (1.0 + (error / (HUBER * sigma)) ** 2)
            weight /= weight.sum()
            x = np.linalg.solve(A.T @ (weight[:, None] * A) + stiff, A.T @ weight + stiff @ goal)
        return replace(self, scale=float(x[0]), shift=float(x[1]) / middle)


NOTHING_FITTED = DepthFit()


def smoothed(predicted_m: Floats) -> Floats:
    """Return predicted depth [H, W] smoothed by a bilateral filter as far as its pixels are noisy; 0 stays 0."""
    read = predicted_m > 0
    logarithm = np.where(read, np.log(np.where(read, predicted_m, 1.0)), HOLE).astype(np.float32)
    noise = pixel_noise(predicted_m)
    if not noise > 0:
        return predicted_m
    smooth = opencv().bilateralFilter(logarithm, DIAMETER_PX, SPREAD_SIGMA * noise, SPREAD_PX)
    return np.where(read, np.exp(smooth), 0.0).astype(np.float32)


def pixel_noise(depth_m: Floats) -> float:
    """Return the standard deviation of the noise of pixels, as a share of the depth, from the inverse depth of three
    neighbours, which is affine on planes; 0 without depth."""
    left, middle, right = depth_m[:, :-2], depth_m[:, 1:-1], depth_m[:, 2:]
    known = (left > 0) & (middle > 0) & (right > 0)
    if not known.any():
        return 0.0
    bend = middle[known] / left[known] + middle[known] / right[known] - 2.0
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0))


def _medians(depth_m: Floats, both: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the median of each cell of `CELL_PX`², 0 where less than half of its pixels are in `both`."""
    n, rows, columns = CELL_PX, depth_m.shape[0] // CELL_PX, depth_m.shape[1] // CELL_PX
    values = np.where(both, depth_m, np.inf)[: rows * n, : columns * n]
    values = np.sort(values.reshape(rows, n, columns, n).swapaxes(1, 2).reshape(rows, columns, n * n), axis=-1)
    count = np.isfinite(values).sum(-1)
    median = np.take_along_axis(values, np.maximum(count - 1, 0)[..., None] // 2, -1)[..., 0]
    return np.where(2 * count >= n * n, median, 0.0).astype(np.float64)
