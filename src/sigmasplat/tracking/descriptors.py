"""Global image descriptors: one vector per frame; views of the same place have a small angle between them."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_erosion, gaussian_filter

from sigmasplat.fit.target import gray_of
from sigmasplat.types import Matrix

Plane = NDArray[np.float32]

WORKING_SIZE = (80, 60)
"""Width and height in pixels of the image that gradients are computed on, for every camera."""
BLUR_PX = 1.0
"""Standard deviation of the blur at that size."""
NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])
"""The pixels whose values give the gradient of the one between them."""
LEAST_READINGS = 0.25
"""A small pixel has depth if at least this share of the large pixels under it have depth."""
SOFTENING = 0.5
"""Softens the normalisation of cells: a cell with little gradient, which is mostly noise, keeps a small norm."""
LEAST_GRADIENT = 1e-4
"""A mean gradient below this (√gray or log m over two pixels) is rounding error: that half of the vector is zero."""
CENTRING = 0.5
"""Share of the mean that is subtracted. All histograms are ≥ 0 and therefore similar; subtracting the whole mean lost
wide-baseline matches."""


class Descriptor(Protocol):
    """Describes a view by a vector: `OrientationGrid` is built in, `netvlad.NetVlad` needs a file of weights."""

    def describe(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a float32 vector [D] of unit norm, or zeros for an image without structure.

        color [H, W, 3] RGB in [0, 1]; depth_m [H, W] metres, 0 = no reading. D does not depend on H and W.
        """


def similarity(a: NDArray[np.float32], b: NDArray[np.float32]) -> Matrix:
    """Return the cosines [n, m] between descriptors a [n, D] and b [m, D], each of unit norm or zero (VarSplat §4)."""
    return a.astype(np.float64) @ b.astype(np.float64).T


@dataclass(frozen=True)
class OrientationGrid:
    """Histograms of gradient orientation on a coarse grid, of gray and of log depth. Needs no weights.

    Directions are modulo 180°: it does not matter which side of an edge is brighter. Magnitudes are normalised within
    each cell: exposure and the unit of depth do not matter. The coarse grid with overlapping cells tolerates a shift of
    a fifth of the image. `depth_share` is the share of depth in the squared norm.
    """

    columns: int = 4
    rows: int = 3
    bins: int = 8
    depth_share: float = 0.35

    def describe(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return float32 [2 · rows · columns · bins] of unit norm: first gray, then depth (`Descriptor.describe`).

        A half without any gradient (a blank wall, no depth readings) is zero; the other half then has unit norm.
        """
        gray = gaussian_filter(_small(np.sqrt(gray_of(color))), BLUR_PX)
        log_depth, valid = _small_log_depth(depth_m)
        halves = [
            np.sqrt(1.0 - self.depth_share) * self._histograms(gray, np.ones_like(valid)),
            np.sqrt(self.depth_share) * self._histograms(log_depth, valid),
        ]
        return _unit(np.concatenate(halves)).astype(np.float32)

    def _histograms(self, image: Plane, valid: NDArray[np.bool_]) -> Matrix:
        """Return the histograms of all cells [rows · columns · bins], unit norm; zero if no gradient is known."""
        dy, dx = np.gradient(2.0 * image.astype(np.float64))
        known = binary_erosion(valid, NEIGHBOURS)  # where the gradient is known
        magnitude, bin_ = np.hypot(dx, dy) * known, np.arctan2(dy, dx) / np.pi % 1.0 * self.bins
        lower = np.floor(bin_).astype(int)
        upper_share = bin_ - lower
        down, across = _tents(self.rows, image.shape[0]), _tents(self.columns, image.shape[1])
        cells = np.empty((self.rows, self.columns, self.bins))
        for k in range(self.bins):
            share = (lower % self.bins == k) * (1.0 - upper_share) + ((lower + 1) % self.bins == k) * upper_share
            cells[..., k] = down @ (magnitude * share) @ across.T
        pixels = down @ known.astype(np.float64) @ across.T
        cells /= np.maximum(pixels, 1e-9)[..., None]
        cells = np.sqrt(cells)
        norms = np.sqrt((cells**2).sum(-1, keepdims=True))
        some = pixels > 0.0
        mean_gradient = float((norms[some] ** 2).mean()) if some.any() else 0.0
        if mean_gradient < LEAST_GRADIENT:
            return np.zeros(cells.size)
        cells /= norms + SOFTENING * np.sqrt(mean_gradient)
        cells[some] -= CENTRING * cells[some].mean()
        return _unit(cells.ravel())


def _small(plane: Plane) -> Plane:
    """Average a plane [H, W] over areas to the working size."""
    whole = Image.fromarray(np.ascontiguousarray(plane, dtype=np.float32))
    return np.asarray(whole.resize(WORKING_SIZE, Image.Resampling.BOX))


def _small_log_depth(depth_m: Plane) -> tuple[Plane, NDArray[np.bool_]]:
    """Average and blur log depth over valid readings only; return it, and which small pixels are valid."""
    measured = depth_m > 0.0
    share = _small(measured.astype(np.float32))
    total = _small(np.log(depth_m, where=measured, out=np.zeros(depth_m.shape, np.float32)))
    valid = share >= LEAST_READINGS
    mean = np.divide(total, share, where=valid, out=np.zeros_like(total))
    weight = gaussian_filter(valid.astype(np.float32), BLUR_PX)
    return np.divide(gaussian_filter(mean, BLUR_PX), weight, where=valid, out=np.zeros_like(mean)), valid


def _tents(cells: int, pixels: int) -> Matrix:
    """Return weights [cells, pixels] that fall linearly from a cell's centre to its neighbours' centres."""
    position = (np.arange(pixels) + 0.5) / pixels * cells - 0.5
    return np.maximum(0.0, 1.0 - np.abs(position[None] - np.arange(cells)[:, None]))


def _unit(vector: Matrix) -> Matrix:
    norm = float(np.linalg.norm(vector))
    return vector / norm if norm > 0.0 else vector
