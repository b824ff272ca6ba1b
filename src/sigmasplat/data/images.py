"""Images of a camera: colour and depth, resized with the compiled kernels (native/resize.h); the noise of depth."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.config.sensors import SensorModel, sensor_model
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
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
        return halved_color(color)
    planes = [np.ascontiguousarray(color[..., c]) for c in range(3)]
    small = [np.asarray(Image.fromarray(plane).resize((width, height), Image.Resampling.BOX)) for plane in planes]
    return np.asarray(np.clip(np.stack(small, -1), 0.0, 1.0), np.float32)


def halved_color(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return colour [2h, 2w, 3] at half the size [h, w, 3], the same bytes as Pillow's box filter."""
    small = np.empty((color.shape[0] // 2, color.shape[1] // 2, 3), np.float32)
    _core.halve_color(np.ascontiguousarray(color), small)
    return small


# ---- depth ----


def resized_depth(
    depth_m: Depth, width: int, height: int, least_m: float = 0.0, most_m: float = float("inf"),
    same_surface: float = SAME_SURFACE,
) -> Depth:  # fmt: skip
    """Return depth [height, width], m, at the centre of each pixel, 0 without a reading in its area, and 0 if it is
    outside [least_m, most_m].

    Depth is interpolated where the four readings around the centre are on one surface (`interpolated_depth`). Elsewhere
    it is the reading of the area that is nearest to the centre: the mean of a near and a far surface is on neither of
    them. same_surface: ratio of depths up to which they are on one surface; 0 = none are.
    """
    if depth_m.shape == (height, width):
        return within(depth_m.copy(), least_m, most_m)
    rows, columns = _axis(depth_m.shape[0], height), _axis(depth_m.shape[1], width)
    small = np.empty((height, width), np.float32)
    _core.resize_depth(
        np.ascontiguousarray(depth_m), *rows, *columns, same_surface,
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
    small = std_m if std_m.shape == depth_m.shape else resized_depth(std_m, width, height, same_surface=0.0)
    return np.where(depth_m > 0, small, np.float32(0.0))


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


@lru_cache(maxsize=16)
def _axis(size: int, resized: int) -> tuple[Indices, Depth]:
    """Return which pixels of an axis a resized one reads [3, n]: the nearest one to each centre, and the two around it;
    and the weight [n] of the last."""
    numbers = Image.fromarray(np.arange(size, dtype=np.int32)[None])
    nearest = np.asarray(numbers.resize((resized, 1), Image.Resampling.NEAREST))[0]
    first, second, share = _around(_centers(size, resized), size)
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

EDGE_SHARE = 0.05
"""Two neighbouring readings that differ by more than this share of the nearer one are on two surfaces."""
SMOOTHED_PX = 5
"""Normals are those of a surface that is averaged over a window of this width: their noise must be far below 1."""
LEAST_COSINE = 0.2
"""Smallest cos θ: normals of surfaces seen at less than 12° are not measured well enough."""


def modelled_std(depth_m: Floats, model: SensorModel, camera: Camera) -> Floats:
    """Return the standard deviation of depth readings [H, W], m, 0 without a reading."""
    std = distance_std(depth_m, model)
    if model.edge != 1.0:
        std = np.where(beside_steps(depth_m), np.float32(model.edge) * std, std)
    if model.grazing:
        std = std * cosines(depth_m, camera) ** np.float32(-model.grazing)
    if model.most < 1.0:
        std = np.minimum(std, np.float32(model.most) * depth_m)
    return np.where(depth_m > 0, std, np.float32(0.0)).astype(np.float32)


def distance_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the part of σ that depends on the distance alone, m [H, W]: √(base² + (z1·z)² + (z2·z²)²)."""
    linear, square = np.float32(model.z1) * depth_m, np.float32(model.z2) * depth_m * depth_m
    return np.asarray(np.sqrt(np.float32(model.base) ** 2 + linear * linear + square * square), np.float32)


def alignment_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the standard deviation of readings in alignment, m [H, W], which does not average out `shared`.

    Only the distance counts: readings at edges and on slanted surfaces are noisier, but they are those that decide the
    pose.
    """
    return np.asarray(np.hypot(distance_std(depth_m, model), np.float32(model.shared) * depth_m * depth_m), np.float32)


def std_by_model(depth_m: Floats, camera: Camera, sensor: str) -> Floats | None:
    """Return the standard deviation of readings [H, W], m, by the model that `input.sensor` names; None without one."""
    model = sensor_model(sensor)
    return None if model is None else modelled_std(depth_m, model, camera)


def generic_std(depth_m: Floats, noise_per_m: float) -> Floats:
    """Return noise · z² of depth readings [H, W], m: the law that is used without a model."""
    return np.asarray(np.float32(noise_per_m) * depth_m * depth_m, np.float32)


def beside_steps(depth_m: Floats) -> NDArray[np.bool_]:
    """Return the readings [H, W] with a reading of another surface among their eight neighbours."""
    cv2, window = opencv(), np.ones((3, 3), np.uint8)
    read = depth_m > 0
    farthest = cv2.dilate(depth_m, window)
    nearest = cv2.erode(np.where(read, depth_m, np.float32(np.inf)), window)
    return np.asarray(read & (farthest - nearest > np.float32(EDGE_SHARE) * nearest))


def cosines(depth_m: Floats, camera: Camera) -> Floats:
    """Return |cos θ| of the angle between ray and normal of depth readings [H, W], at least `LEAST_COSINE`; 1 where the
    neighbours do not show a surface.

    The inverse depth w of a plane is affine in the image: its slopes give the normal (f_x w_u, f_y w_v, w at the
    principal point).
    """
    cv2, reach = opencv(), SMOOTHED_PX // 2
    read = (depth_m > 0).astype(np.float32)
    inverse = np.divide(read, depth_m, out=np.zeros_like(depth_m), where=read > 0)
    size, border = (SMOOTHED_PX, SMOOTHED_PX), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(read, -1, size, normalize=False, borderType=border)
    w = cv2.boxFilter(inverse, -1, size, normalize=False, borderType=border) / np.maximum(count, np.float32(1.0))
    full, slopes = count == SMOOTHED_PX**2, []
    known = read > 0
    for axis in (1, 0):
        ahead, behind = np.roll(w, -reach, axis), np.roll(w, reach, axis)
        known = known & np.roll(full, -reach, axis) & np.roll(full, reach, axis)
        known &= np.abs(ahead - behind) < np.float32(EDGE_SHARE * 2 * reach) * w
        slopes.append((ahead - behind) / np.float32(2 * reach))
    v, u = np.indices(depth_m.shape, np.float32)
    off_u, off_v = u - np.float32(camera.cx), v - np.float32(camera.cy)
    normal = np.stack([camera.fx * slopes[0], camera.fy * slopes[1], w - slopes[0] * off_u - slopes[1] * off_v])
    ray = np.sqrt(1.0 + (off_u / camera.fx) ** 2 + (off_v / camera.fy) ** 2)
    cosine = w / np.maximum(ray * np.sqrt((normal**2).sum(0)), np.float32(1e-12))
    cosine = np.clip(cosine, LEAST_COSINE, 1.0)
    return np.where(known, cosine, np.float32(1.0)).astype(np.float32)
