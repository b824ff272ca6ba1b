"""Resize colour and depth of a camera image with the compiled kernels (native/resize.h).

The functions that end in `_in_numpy` define the results, and replace the kernels where they are not built. Both give
the same bytes.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.native import kernels

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
        return halved_color(color)
    planes = [np.ascontiguousarray(color[..., c]) for c in range(3)]
    small = [np.asarray(Image.fromarray(plane).resize((width, height), Image.Resampling.BOX)) for plane in planes]
    return np.asarray(np.clip(np.stack(small, -1), 0.0, 1.0), np.float32)


def halved_color(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return colour [2h, 2w, 3] at half the size [h, w, 3], the same bytes as Pillow's box filter."""
    core = kernels()
    if core is None:
        return halved_color_in_numpy(color)
    small = np.empty((color.shape[0] // 2, color.shape[1] // 2, 3), np.float32)
    core.halve_color(np.ascontiguousarray(color), small)
    return small


def halved_color_in_numpy(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what `halved_color` returns."""
    small = np.empty((color.shape[0] // 2, color.shape[1] // 2, 3), np.float32)
    for c in range(3):
        rows = color[:, ::2, c] + color[:, 1::2, c]
        np.add(rows[::2], rows[1::2], out=small[..., c])
    small *= np.float32(0.25)
    return np.clip(small, 0.0, 1.0, out=small)


# ---- depth ----


def resized_depth(depth_m: Depth, width: int, height: int, least_m: float = 0.0, most_m: float = float("inf")) -> Depth:
    """Return depth [height, width], m, at the centre of each pixel, 0 without a reading in its area, and 0 if it is
    outside [least_m, most_m].

    Depth is interpolated where the four readings around the centre are on one surface (`interpolated_depth`). Elsewhere
    it is the reading of the area that is nearest to the centre: the mean of a near and a far surface is on neither of
    them.
    """
    core = kernels()
    if core is None or depth_m.shape == (height, width):
        return within(resized_depth_in_numpy(depth_m, width, height), least_m, most_m)
    rows, columns = _axis(depth_m.shape[0], height), _axis(depth_m.shape[1], width)
    small = np.empty((height, width), np.float32)
    core.resize_depth(
        np.ascontiguousarray(depth_m), rows.pixels, rows.share, columns.pixels, columns.share, SAME_SURFACE,
        *_area_in_order(depth_m.shape[0], height, depth_m.shape[1], width), least_m, most_m, small,
    )  # fmt: skip
    return small


def within(depth_m: Depth, least_m: float, most_m: float) -> Depth:
    """Return depth with 0 where it is outside [least_m, most_m]; the same array if nothing is."""
    keep = (depth_m >= least_m) & (depth_m <= most_m)
    return depth_m if keep.all() else np.where(keep, depth_m, np.float32(0.0))


def resized_std(std_m: Depth | None, depth_m: Depth) -> Depth | None:
    """Return the standard deviation [H, W] of resized depth [H, W], both m: that of the reading nearest to each pixel's
    centre, 0 without depth. None stays None."""
    if std_m is None:
        return None
    height, width = depth_m.shape
    small = std_m if std_m.shape == depth_m.shape else _nearest_depth(std_m, width, height)
    return np.where(depth_m > 0, small, np.float32(0.0))


def resized_depth_in_numpy(depth_m: Depth, width: int, height: int) -> Depth:
    """Return what `resized_depth` returns without limits."""
    if depth_m.shape == (height, width):
        return depth_m.copy()
    nearest = _nearest_depth(depth_m, width, height)
    rows, columns = (_centers(m, n) for n, m in zip((height, width), depth_m.shape, strict=True))
    return interpolated_depth(depth_m, rows, columns, nearest)


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


def _centers(size: int, resized: int) -> NDArray[np.float64]:
    """Return the centres of `resized` pixels in pixels of an axis of `size`."""
    return (np.arange(resized, dtype=np.float64) + 0.5) * (size / resized) - 0.5


def _around(positions: NDArray[np.float64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Depth]:
    """Return the two pixels around each position on an axis of `size` pixels, and the weight of the second one."""
    first = np.floor(positions)
    pixels = first.astype(np.intp)
    share = (positions - first).astype(np.float32)
    return np.clip(pixels, 0, size - 1), np.clip(pixels + 1, 0, size - 1), share


def _nearest_depth(depth_m: Depth, width: int, height: int) -> Depth:
    """Return in each pixel's area the reading nearest to its centre, 0 without a reading."""
    small = np.array(Image.fromarray(depth_m).resize((width, height), Image.Resampling.NEAREST), np.float32)
    holes = np.flatnonzero(small == 0.0)
    if not len(holes):
        return small
    readings, filled = depth_m.ravel(), small.ravel()
    for at_rows, at_columns in zip(*_area_in_order(depth_m.shape[0], height, depth_m.shape[1], width), strict=True):
        source = (at_rows.astype(np.intp) * depth_m.shape[1])[:, None] + at_columns
        found = readings.take(source.ravel().take(holes))
        filled[holes] = found
        holes = holes[found == 0.0]
    return small


@dataclass(frozen=True, eq=False)
class _Axis:
    """Which pixels of an axis a resized one reads [3, n]: the nearest one to each centre, and the two around it, with
    the weight [n] of the second."""

    pixels: Indices
    share: Depth


@lru_cache(maxsize=16)
def _axis(size: int, resized: int) -> _Axis:
    numbers = Image.fromarray(np.arange(size, dtype=np.int32)[None])
    nearest = np.asarray(numbers.resize((resized, 1), Image.Resampling.NEAREST))[0]
    first, second, share = _around(_centers(size, resized), size)
    return _Axis(np.stack([nearest, first, second]).astype(np.int32), share)


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
