"""Images of a camera: colour and depth, resized with the compiled kernels (native/resize.h); the noise of depth."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.config.input import SensorModel
from sigmasplat.native import _core

Depth = NDArray[np.float32]
Indices = NDArray[np.int32]

SAME_SURFACE = 1.03
"""Neighbouring depths up to this ratio are on one surface, so depth between them is interpolated."""


# ---- colour ----


def resized_color(color: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return colour [height, width, 3], each pixel the mean over its area."""
    if color.shape[:2] == (height, width):
        return color
    if color.shape[:2] == (2 * height, 2 * width):
        small = np.empty((height, width, 3), np.float32)  # the same bytes as Pillow's box filter
        _core.halve_color(np.ascontiguousarray(color), small)
        return small
    planes = [np.ascontiguousarray(color[..., c]) for c in range(3)]
    means = [np.asarray(Image.fromarray(plane).resize((width, height), Image.Resampling.BOX)) for plane in planes]
    return np.asarray(np.clip(np.stack(means, -1), 0.0, 1.0), np.float32)


# ---- depth ----


def resized_depth(
    depth_m: Depth, width: int, height: int, least_m: float = 0.0, most_m: float = float("inf")
) -> Depth:  # fmt: skip
    """Return depth [height, width], m, at the centre of each pixel, 0 without a reading in its area, and 0 if it is
    outside [least_m, most_m].

    Depth is interpolated where the four readings around the centre are on one surface (`interpolated_depth`). Elsewhere
    it is the reading of the area that is nearest to the centre: the mean of a near and a far surface is on neither.
    """
    if depth_m.shape == (height, width):
        return within(depth_m.copy(), least_m, most_m)
    rows, columns = _axis(depth_m.shape[0], height), _axis(depth_m.shape[1], width)
    small = np.empty((height, width), np.float32)
    _core.resize_depth(
        np.ascontiguousarray(depth_m), *rows, *columns, SAME_SURFACE,
        *_area_in_order(depth_m.shape[0], height, depth_m.shape[1], width), least_m, most_m, small,
    )  # fmt: skip
    return small


def within(depth_m: Depth, least_m: float, most_m: float) -> Depth:
    """Return depth with 0 where it is outside [least_m, most_m]; the same array if nothing is."""
    keep = (depth_m >= least_m) & (depth_m <= most_m)
    return depth_m if keep.all() else np.where(keep, depth_m, np.float32(0.0))


def interpolated_depth(
    depth_m: Depth, rows: NDArray[np.float64], columns: NDArray[np.float64], otherwise: Depth
) -> Depth:
    """Return depth [H, W], m, interpolated at rows [H] and columns [W] (fractional pixels).

    Where the four readings around a position are not on one surface (`SAME_SURFACE`), or where `otherwise` [H, W] is 0,
    the value of `otherwise` is returned. Depth outside the image is that of its edge.
    """
    (top, bottom, down), (left, right, across) = (
        _around(positions, size) for positions, size in zip((rows, columns), depth_m.shape, strict=True)
    )
    corners = [depth_m[y][:, x] for y in (top, bottom) for x in (left, right)]
    least, most = np.minimum.reduce(corners), np.maximum.reduce(corners)
    above, below = (corners[k] + across * (corners[k + 1] - corners[k]) for k in (0, 2))
    smooth = (least > 0) & (most < SAME_SURFACE * least) & (otherwise > 0)
    return np.where(smooth, above + down[:, None] * (below - above), otherwise)


def _around(positions: NDArray[np.float64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Depth]:
    """Return the two pixels around each position on an axis of `size` pixels, and the weight of the second one."""
    first = np.floor(positions)
    pixels = first.astype(np.intp)
    share = (positions - first).astype(np.float32)
    return np.clip(pixels, 0, size - 1), np.clip(pixels + 1, 0, size - 1), share


@lru_cache(maxsize=16)
def _axis(size: int, resized: int) -> tuple[Indices, Depth]:
    """Return which pixels of an axis a resized one reads [3, n]: the nearest one to each centre, and the two around it;
    and the weight [n] of the last."""
    numbers = Image.fromarray(np.arange(size, dtype=np.int32)[None])
    nearest = np.asarray(numbers.resize((resized, 1), Image.Resampling.NEAREST))[0]
    centers = (np.arange(resized, dtype=np.float64) + 0.5) * (size / resized) - 0.5
    first, second, share = _around(centers, size)
    return np.stack([nearest, first, second]).astype(np.int32), share


@lru_cache(maxsize=16)
def _area_in_order(height: int, rows: int, width: int, columns: int) -> tuple[Indices, Indices]:
    """Return the other pixels of each resized pixel's area, nearest to its centre first: source rows [K, rows] and
    columns [K, columns]."""
    at_rows, at_columns = _area(height, rows), _area(width, columns)
    around = [(dy, dx) for dy in at_rows for dx in at_columns if dy or dx]
    around.sort(key=lambda d: d[0] ** 2 + d[1] ** 2)
    found = ([at_rows[dy] for dy, _ in around], rows), ([at_columns[dx] for _, dx in around], columns)
    of_rows, of_columns = (np.array(pixels, np.int32).reshape(len(around), size) for pixels, size in found)
    return of_rows, of_columns


def _area(size: int, resized: int) -> dict[int, NDArray[np.intp]]:
    """Return the source pixels whose centres a resized row of pixels covers, by their offset from the nearest one.

    Where a pixel does not reach as far as the offset, its outermost source pixel is repeated.
    """
    edges = np.arange(resized + 1) * (size / resized)
    nearest = (edges[:-1] + 0.5 * size / resized).astype(np.intp)
    inside = np.ceil(edges - 0.5).astype(np.intp)
    first, last = np.minimum(inside[:-1], nearest), np.maximum(inside[1:] - 1, nearest)
    offsets = range(int((first - nearest).min()), int((last - nearest).max()) + 1)
    return {offset: np.clip(nearest + offset, first, last) for offset in offsets}


Floats = NDArray[np.float32]


def distance_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the part of σ that depends on the distance alone, m [H, W]: √(base² + (z1·z)² + (z2·z²)²)."""
    linear, square = np.float32(model.z1) * depth_m, np.float32(model.z2) * depth_m * depth_m
    return np.asarray(np.sqrt(np.float32(model.base) ** 2 + linear * linear + square * square), np.float32)


def alignment_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the standard deviation of readings in alignment, m [H, W], which does not average out `shared`.

    Only the distance counts: readings at edges and on slanted surfaces are noisier, but they decide the pose.
    """
    return np.asarray(np.hypot(distance_std(depth_m, model), np.float32(model.shared) * depth_m * depth_m), np.float32)


def generic_std(depth_m: Floats, noise_per_m: float) -> Floats:
    """Return noise · z² of depth readings [H, W], m: the law that is used without a model."""
    return np.asarray(np.float32(noise_per_m) * depth_m * depth_m, np.float32)
