"""Definitions in numpy of the kernels that prepare and compare images (native/resize.h, compare.h, free_space.h,
read_at_once.h)."""

from typing import Any

import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray

from row_times import color_s, depth_s
from sigmasplat.data import images, se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import Readout
from sigmasplat.fit.compare import (
    CLOSE_M,
    CLOSE_SIGMA,
    FLAT,
    LEAST_PIXELS,
    NOISE_M,
    NOTHING,
    STEP,
    Comparison,
)
from sigmasplat.fit.interface import DEPTH_STEP_M
from sigmasplat.fit.pyramid import HIDDEN_M, NOISE_PER_M, Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.tracking.moving.free_space import AROUND_PX, CLEAR_M, CLEAR_RELATIVE, least_around, on_image
from sigmasplat.types import Matrix

Image = NDArray[np.float32]
Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]


def halved_in_numpy(image: Image) -> Image:
    """Return the same bytes as `halved`."""
    return np.asarray(_quarter(image).mean(0))


def halved_depth_in_numpy(depth: Image, step_m: float = DEPTH_STEP_M) -> Image:
    """Return the same bytes as `halved_depth`."""
    cells = _quarter(depth)
    readings = (cells > 0).sum(0, dtype=np.float32)
    near, far = np.where(cells > 0, cells, np.float32(np.inf)).min(0), cells.max(0)
    mean = cells.sum(0) / np.maximum(readings, 1)
    return np.where((readings > 1) & (far - near < step_m), mean, np.float32(0.0))


def _quarter(image: Image) -> Image:
    """Return the four pixels of each 2×2 cell, stacked as [4, H/2, W/2]."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[0:h:2, 0:w:2], image[0:h:2, 1:w:2], image[1:h:2, 0:w:2], image[1:h:2, 1:w:2]])


def halved_color_in_numpy(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return colour at half the size, as `resized_color` does."""
    small = np.empty((color.shape[0] // 2, color.shape[1] // 2, 3), np.float32)
    for c in range(3):
        rows = color[:, ::2, c] + color[:, 1::2, c]
        np.add(rows[::2], rows[1::2], out=small[..., c])
    small *= np.float32(0.25)
    return np.clip(small, 0.0, 1.0, out=small)


def nearest_depth(depth_m: Depth, width: int, height: int) -> Depth:
    """Return in each pixel's area the reading nearest to its centre, 0 without a reading."""
    small = np.array(PIL.Image.fromarray(depth_m).resize((width, height), PIL.Image.Resampling.NEAREST), np.float32)
    holes = np.flatnonzero(small == 0.0)
    if not len(holes):
        return small
    readings, filled = depth_m.ravel(), small.ravel()
    for at_rows, at_columns in zip(
        *images._area_in_order(depth_m.shape[0], height, depth_m.shape[1], width), strict=True
    ):
        source = (at_rows.astype(np.intp) * depth_m.shape[1])[:, None] + at_columns
        found = readings.take(source.ravel().take(holes))
        filled[holes] = found
        holes = holes[found == 0.0]
    return small


def resized_depth_in_numpy(depth_m: Depth, width: int, height: int) -> Depth:
    """Return what `resized_depth` returns without limits."""
    if depth_m.shape == (height, width):
        return depth_m.copy()
    nearest = nearest_depth(depth_m, width, height)
    sizes = zip((height, width), depth_m.shape, strict=True)
    rows, columns = ((np.arange(n, dtype=np.float64) + 0.5) * (m / n) - 0.5 for n, m in sizes)
    return images.interpolated_depth(depth_m, rows, columns, nearest)


def noise_m(depth_m: Matrix, noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0) -> Matrix:
    """Return the standard deviation assumed for depth readings, metres; its constant grows with the scene."""
    return np.asarray(noise_per_m * depth_m**2 + NOISE_M * scene_scale)


def compare_in_numpy(reference: Pyramid, live: Pyramid, T_live_reference: Matrix) -> Comparison:
    """Return what `compare` returns, but for rounding."""
    level = 0
    host, camera = reference.kernels.to_host, reference.cameras[level]
    depth, gray = (host(plane)[::STEP, ::STEP] for plane in (reference.depth[level], reference.gray[level]))
    v, u = np.nonzero(depth > 0)
    if len(u) < LEAST_PIXELS:
        return NOTHING
    z = depth[v, u].astype(np.float64)
    rays = np.stack([(STEP * u - camera.cx) / camera.fx, (STEP * v - camera.cy) / camera.fy, np.ones(len(u))])
    x, y, seen = T_live_reference[:3, :3] @ (rays * z) + T_live_reference[:3, 3:]
    ahead = np.maximum(seen, 1e-3)
    column, row = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
    inside = (seen > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width - 1) & (row < camera.height - 1)
    if inside.sum() < LEAST_PIXELS:
        return NOTHING
    left, top, seen = column[inside].astype(np.intp), row[inside].astype(np.intp), seen[inside]
    live_depth = host(live.depth[level])
    hidden = live_depth >= HIDDEN_M
    live_depth = np.where(hidden, np.float32(0.0), live_depth)
    other, difference = _nearest_surface(live_depth, left, top, seen)
    count, comparable = int(other.sum()), len(u) - int((hidden[top, left] & ~other).sum())
    if count < LEAST_PIXELS:
        return NOTHING
    difference, noise = difference[other], noise_m(seen[other], live.noise_per_m, live.scene_scale)
    noise = noise * noise_scale_in_numpy(live_depth, live.noise_per_m, live.scene_scale)
    limit = CLOSE_SIGMA * noise + CLOSE_M * live.scene_scale
    covered = min(1.0, count / max(int(np.count_nonzero(live_depth[::STEP, ::STEP])), 1))
    front = difference <= -limit
    close, behind = (float(np.mean(found)) for found in (np.abs(difference) < limit, difference >= limit))
    common, before = count / comparable, float(np.mean(front))
    if count - front.sum() < LEAST_PIXELS:
        return Comparison(common, close, before, behind, float("inf"), float("nan"), count, covered)
    residual = float(np.median(np.abs(difference)[~front] / noise[~front]))
    right, below = column[inside] - left > 0.5, row[inside] - top > 0.5
    live_gray = host(live.gray[level])[top + below, left + right]
    correlation = _correlation(gray[v, u][inside][other][~front], live_gray[other][~front])
    return Comparison(common, close, before, behind, residual, correlation, count, covered)


def noise_scale_in_numpy(
    depth: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0
) -> float:
    """Return the same value as `noise_scale`."""
    rows = depth[::STEP]
    width = (rows.shape[1] - 2) // STEP * STEP
    left, middle, right = (rows[:, i : i + width : STEP] for i in range(3))
    read = (left > 0) & (middle > 0) & (right > 0)
    if read.sum() < LEAST_PIXELS:
        return 1.0
    noise = noise_m(middle[read].astype(np.float64), noise_per_m, scene_scale)
    bend = np.abs(middle[read] - 0.5 * (left[read] + right[read])) / noise
    # For normal noise the bend has 1.22 standard deviations, and the median of its absolute value is 0.67 of these.
    return max(1.0, float(np.median(bend)) / (1.2247 * 0.6745))


def _nearest_surface(
    depth: NDArray[np.float32], left: NDArray[np.intp], top: NDArray[np.intp], expected_m: Matrix
) -> tuple[NDArray[np.bool_], Matrix]:
    """Return which points fall on a reading, and the difference to the one of the four neighbours that is closest to
    the expected depth: at a depth step either surface may be the right one."""
    best = np.full(len(left), np.inf)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        reading = depth[top + down, left + across]
        difference = np.where(reading > 0, reading - expected_m, np.inf)
        best = np.where(np.abs(difference) < np.abs(best), difference, best)
    return np.isfinite(best), best


def _correlation(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    a, b = one - one.mean(dtype=np.float64), other - other.mean(dtype=np.float64)
    norms = float(np.sqrt(np.mean(a * a))), float(np.sqrt(np.mean(b * b)))
    return float(np.mean(a * b)) / (norms[0] * norms[1]) if min(norms) > FLAT else float("nan")


def free_places_in_numpy(
    points_m: Depth, T_camera_points: Matrix, depth_m: Depth, camera: Camera, clear_m: float = CLEAR_M,
    further_px: int = 0,
) -> Mask:  # fmt: skip
    """Return what `free_places` returns."""
    X, Y, Z = points_m.astype(np.float64)
    # The sums are explicit: those of a library's matrix product depend on how the memory is aligned.
    x, y, z = (r[0] * X + r[1] * Y + r[2] * Z + r[3] for r in T_camera_points[:3])
    inside, row, column = on_image(x, y, z, camera)
    near_m = least_around(depth_m, AROUND_PX + 2 * further_px)[row, column]
    return np.asarray(inside & (near_m < np.inf) & (z * (1 + CLEAR_RELATIVE) + clear_m < near_m))


def target_in_torch(frame: Frame, size: tuple[int, int]) -> Target:
    """Return what `Target.of` returns."""
    h, w = frame.depth_m.shape
    color, depth = torch.zeros(3, *size), torch.zeros(size)
    color[:, :h, :w] = torch.tensor(frame.color).movedim(-1, 0)
    depth[:h, :w] = torch.tensor(frame.depth_m)
    return Target(frame.camera, color, depth, int((frame.depth_m > 0).sum()))


def read_before_in_numpy(depth_m: Image, camera: Camera, readout: Readout, of_color: bool) -> tuple[Image, Image]:
    """Return the depth that `read_before` writes, and where colour shows it [2, H, W], with exact motions."""
    c, (height, width) = camera, depth_m.shape
    own, usual_m = np.indices(depth_m.shape, np.float64), float(np.median(depth_m[::4, ::4][depth_m[::4, ::4] > 0]))

    def seen(z: NDArray[np.float64], late_s: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, ahead = moved((own[1] - c.cx) / c.fx * z, (own[0] - c.cy) / c.fy * z, z, late_s)
        return np.stack([c.fx * x / ahead + c.cx, c.fy * y / ahead + c.cy])

    def moved(x: Any, y: Any, z: Any, late_s: Any) -> NDArray[np.float64]:
        T = se3.inverse(se3.exp_stack(np.broadcast_to(late_s, z.shape).reshape(-1, 1) * readout.rate))
        points = np.stack([x, y, z, np.ones_like(z)], -1).reshape(-1, 4)
        return np.einsum("nij,nj->ni", T[:, :3], points).T.reshape(3, *z.shape)

    z, row, of_row = depth_m.astype(np.float64), own[0], color_s(readout, own[0], height) if of_color else 0.0
    for _ in range(2):
        late_s = depth_s(readout, row, height) - of_row
        column, row = seen(np.where(z > 0, z, usual_m), late_s)
        if of_color:
            column, row = column.clip(0, width - 1), row.clip(0, height - 1)
        u, v = np.floor(column).astype(int).clip(0, width - 1), np.floor(row).astype(int).clip(0, height - 1)
        below, right = (v + 1).clip(0, height - 1), (u + 1).clip(0, width - 1)
        four = np.stack([depth_m[y, x] for y in (v, below) for x in (u, right)])
        a, b = (column - u).clip(0, 1), (row - v).clip(0, 1)
        nearest = np.take_along_axis(four, (2 * (b > 0.5) + (a > 0.5))[None], 0)[0]
        between = (1 - b) * ((1 - a) * four[0] + a * four[1]) + b * ((1 - a) * four[2] + a * four[3])
        read = np.where(np.ptp(four, axis=0) < 0.03 * four.min(0), between, nearest)
        outside = (column < -0.5) | (row < -0.5) | (column >= width - 0.5) | (row >= height - 0.5)
        read = np.where(outside | (nearest <= 0), 0.0, read)
        z = np.where(read > 0, moved((column - c.cx) / c.fx * read, (row - c.cy) / c.fy * read, read, -late_s)[2], 0.0)
    at = own[::-1]
    for _ in range(2):
        at = seen(np.where(z > 0, z, usual_m), color_s(readout, at[1], height))
    return z.clip(0.0).astype(np.float32), at.astype(np.float32)
