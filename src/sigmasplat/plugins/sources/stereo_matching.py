"""Compute depth from a rectified stereo pair: match both images, refine below a pixel, convert disparity to depth.

Semi-global matching prefers some fractions of a pixel, by up to 0.2 px; `refine` removes that.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Camera, opencv

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

FIT_REACH_PX, SPREAD_PX = 5, 3.3
"""The window: its half edge, and the standard deviation of its Gaussian weights."""
SMOOTH_PX, STEPS = 0.7, 2
"""Standard deviation of the smoothing of both images: their noise, and less aliasing in the gradient; iterations."""
FAR_OFF, LARGEST_PX = 10.0, 1.0
"""A pixel whose gray values differ by this much counts half (of 255; Geman–McClure). Largest change of a disparity."""
FLAT, PRIOR = 4.0, 1.0
"""Prior of no slope: like this much squared gradient one pixel from the centre of the window. Weight of the disparity
that matching found, as squared gradient in gray values per pixel."""


@dataclass(frozen=True, eq=False)
class Subpixel:
    """disparity: refined, px [H, W]; texture: root of the squared gradients that decide it, gray values per pixel;
    residual: root mean square difference of the images in the window, gray values."""

    disparity: Floats
    texture: Floats
    residual: Floats


def refine(left: Bytes, right: Bytes, disparity: Floats, smooth: NDArray[np.bool_]) -> Subpixel:
    """Fit a plane of disparity to the window around each pixel, so that the right image agrees with the left one.

    left, right: rectified gray images [H, W]; disparity: px [H, W]; smooth: pixels whose disparity is known and away
    from edges. Others keep their disparity and are not used. The mean difference of each window is left out, as two
    cameras differ in brightness (least squares, Lucas and Kanade 1981; weights of Geman and McClure 1985).
    """
    cv2 = opencv()
    a, b = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX) for image in (left, right))
    slope = cv2.Sobel(b, cv2.CV_32F, 1, 0, scale=1 / 8)
    rows, columns = np.indices(a.shape, np.float32)
    used, found, decided = smooth.astype(np.float32), disparity, np.zeros_like(disparity)
    count = _window(used) + np.float32(1e-6)

    def difference(at: Floats) -> Floats:
        there = cv2.remap(b, at, rows, cv2.INTER_CUBIC) - a
        return np.asarray(there - _window(used * there) / count, np.float32)

    for _ in range(STEPS):
        apart, gradient = difference(columns - found), cv2.remap(slope, columns - found, rows, cv2.INTER_LINEAR)
        weight = used / (1.0 + (apart / np.float32(FAR_OFF)) ** 2)
        planes, decided = _planes(weight, gradient, apart + gradient * found, disparity)
        near = np.clip(planes, disparity - np.float32(LARGEST_PX), disparity + np.float32(LARGEST_PX))
        found = np.where(smooth, near, disparity).astype(np.float32)
    residual = np.sqrt(_window(used * difference(columns - found) ** 2) / count)
    return Subpixel(found, np.sqrt(decided), residual)


def _planes(weight: Floats, gradient: Floats, wanted: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Solve Σ w (g·(d + p·x + q·y) − wanted)² for d at the centre of each window [H, W]; return it, and the squared
    gradients that decide it after p and q are chosen (Schur complement)."""
    square, target = weight * gradient * gradient, weight * gradient * wanted
    s, x, y = _window(square), _window(square, 1, 0), _window(square, 0, 1)
    xx, xy, yy = (_window(square, i, 2 - i) for i in (2, 1, 0))
    xx, yy = xx + np.float32(FLAT), yy + np.float32(FLAT)
    t, tx, ty = _window(target), _window(target, 1, 0), _window(target, 0, 1)
    determinant = xx * yy - xy * xy
    along_x, along_y = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant
    decided = np.maximum(s - along_x * x - along_y * y, 0.0)
    d = (t - along_x * tx - along_y * ty + np.float32(PRIOR) * prior) / (decided + np.float32(PRIOR))
    return np.asarray(d, np.float32), np.asarray(decided, np.float32)


def _window(image: Floats, powers_x: int = 0, powers_y: int = 0) -> Floats:
    """Return the weighted mean of image · x^powers_x · y^powers_y over the window around each pixel [H, W]."""
    cv2 = opencv()
    offset = np.arange(-FIT_REACH_PX, FIT_REACH_PX + 1, dtype=np.float32)
    gaussian = np.exp(-0.5 * (offset / SPREAD_PX) ** 2)
    gaussian /= gaussian.sum()
    along = [(gaussian * offset**power).astype(np.float32) for power in (powers_x, powers_y)]
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, *along, borderType=cv2.BORDER_CONSTANT), np.float32)


BLOCK_PX, PREFILTER, SUBPIXELS = 5, 31, 16.0
"""Edge of the matched blocks; largest value of the horizontal derivative that is compared; OpenCV's unit of disparity,
per pixel."""
SMALL_STEP, LARGE_STEP = 8 * BLOCK_PX**2, 32 * BLOCK_PX**2
"""Penalties of a disparity step of 1 px, and of a larger one (OpenCV's recommendation for one channel)."""
CONSISTENT_PX, UNIQUE_PERCENT = 1, 10
"""Left–right check: largest difference of the disparities that the two images find. The best match must be better than
the second one by this."""
SPECKLE_PX, SPECKLE_STEP_PX = 100, 1
"""Regions with fewer pixels are removed; within a region neighbours differ by at most this disparity."""
REACH_PX, MOST_BEND_PX = 2, 0.6
"""Readings are removed where the disparity differs by more than `MOST_BEND_PX` from the mean of its neighbours at this
distance, or next to such places, before or after the refinement: those are edges and wrong matches."""
STD_PX, MAX_STD = 0.15, 0.05
"""Standard deviation σ_d of the disparity where matching is sure. Stereo depth z has σ_z = z²·σ_d / (f·b); depth is
ignored where σ_z is larger than this share of it."""
STD_MATCH, STD_HOLE, STD_RANGE, STD_BEND = 1.04, 3.8, 0.51, 7.15
"""Parts of σ_d in units of `STD_PX`. For each gray value by which the images differ after the refinement:
divided by the gradient that decides it; at a pixel without a reading, where the surface ends, falling by e every
`HOLE_PX`; for each pixel in the range of disparities around, as a near surface looks wider than it is. Besides: for
each pixel by which the disparity bends. Fitted to exact depth of synthetic rooms (seeds 1 to 4; baselines of 6, 10 and
18 cm)."""
TAILS, LEAST_TEXTURE = 2.0, 0.5
"""Root mean square of the errors in the disparity relative to `STD_PX`: a few are much larger than σ_d. Smallest
gradient that is divided by, in gray values per pixel."""
HOLE_PX, AROUND_PX, MOST_RANGE_PX, LEAST_TOGETHER = 8.0, 13, 2.0, 0.85
"""The window of the range of disparities, and its largest value. Readings are removed where a smaller share of this
window has a match: those are often wrong by several pixels."""
INDOOR_MEDIAN_M, SMALL_SCENE = 2.0, 2.0
"""Median depth of a usual indoor recording, for which the default settings are made; scenes below this multiple of it
use them."""


class StereoMatcher:
    """Depth by semi-global matching (Hirschmüller 2008, OpenCV's five directions, one thread)."""

    def __init__(self, camera: Camera, baseline_m: float) -> None:
        """Prepare for rectified images of `camera`, whose right one is `baseline_m` to the right."""
        self.camera, self._focal_baseline = camera, camera.fx * baseline_m
        self._count = max(16, -(-camera.width // 128) * 16)

    def depth_and_std_m(self, left: Bytes, right: Bytes) -> tuple[Floats, Floats]:
        """Match two rectified RGB images [H, W, 3]: depth z of the left one, m [H, W], 0 = no reading, and its standard
        deviation σ_z = z² σ_d / (f b), m [H, W]. σ_d is larger where there is little texture, where the surface bends,
        and near its edges."""
        cv2, n = opencv(), self._count
        # The columns left of the image let far points near the left edge be matched.
        gray = [
            cv2.copyMakeBorder(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 0, 0, n, 0, cv2.BORDER_REPLICATE)
            for image in (left, right)
        ]
        matcher = cv2.StereoSGBM_create(
            minDisparity=0, numDisparities=n, blockSize=BLOCK_PX, P1=SMALL_STEP, P2=LARGE_STEP,
            disp12MaxDiff=CONSISTENT_PX, preFilterCap=PREFILTER, uniquenessRatio=UNIQUE_PERCENT,
            speckleWindowSize=SPECKLE_PX, speckleRange=SPECKLE_STEP_PX, mode=cv2.STEREO_SGBM_MODE_SGBM,
        )  # fmt: skip
        found = matcher.compute(*gray)[:, n:].astype(np.float32) / np.float32(SUBPIXELS)
        column = np.arange(left.shape[1], dtype=np.float32)
        matched = (found > 0) & (column - found >= BLOCK_PX // 2)
        together = cv2.blur(matched.astype(np.float32), (AROUND_PX, AROUND_PX)) >= LEAST_TOGETHER
        smooth = matched & together & (_bend(found, matched) <= MOST_BEND_PX)
        fine = refine(gray[0][:, n:], gray[1][:, n:], found, smooth)
        bend_px = _bend(fine.disparity, matched)
        seen = smooth & (bend_px <= MOST_BEND_PX)
        depth_m = np.divide(self._focal_baseline, fine.disparity, out=np.zeros_like(found), where=seen)
        std_px = STD_PX * _relative_std(fine, matched, smooth, bend_px)
        std_m = depth_m * depth_m * std_px / self._focal_baseline
        usable = std_m <= MAX_STD * depth_m
        return np.where(usable, depth_m, 0.0).astype(np.float32), np.where(usable, std_m, 0.0).astype(np.float32)

    @property
    def noise_per_m(self) -> float:
        """Return the root mean square error of readings, relative to z²."""
        return TAILS * STD_PX / self._focal_baseline


def scene_scale(depth_of: Callable[[int], Floats], frames: int) -> float:
    """Return the size of a scene relative to a room, from the median depth of the first frame that has readings.

    It is 1 for a median below 4 m; else the median divided by 2 m, with two digits.
    """
    for i in range(min(frames, 5)):
        depth_m = depth_of(i)
        if (depth_m > 0).any():
            ratio = float(np.median(depth_m[depth_m > 0])) / INDOOR_MEDIAN_M
            return float(f"{ratio:.2g}") if ratio >= SMALL_SCENE else 1.0
    return 1.0


def _relative_std(fine: Subpixel, matched: NDArray[np.bool_], smooth: NDArray[np.bool_], bend_px: Floats) -> Floats:
    """Return σ_d in units of `STD_PX` [H, W]; matched: pixels with a disparity, smooth: refined ones."""
    cv2, window = opencv(), np.ones((AROUND_PX, AROUND_PX))
    far, near = (np.where(matched, sign * fine.disparity, np.float32(-1e6)) for sign in (-1.0, 1.0))
    range_px = cv2.dilate(near, window) + cv2.dilate(far.astype(np.float32), window)
    to_hole_px = cv2.distanceTransform(smooth.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    per_gray_value = (
        (STD_MATCH / np.maximum(fine.texture, LEAST_TEXTURE)) ** 2
        + (STD_HOLE * np.exp(-to_hole_px / HOLE_PX)) ** 2
        + (STD_RANGE * np.clip(range_px, 0.0, MOST_RANGE_PX)) ** 2
    )
    bent = (STD_BEND * np.where(smooth, bend_px, 0.0)) ** 2
    return np.asarray(np.sqrt(fine.residual**2 * per_gray_value + bent), np.float32)


def _bend(disparity: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Return the largest difference between a disparity and the mean of its two neighbours in row or column, within
    two pixels, px [H, W]; neighbours without a match are not compared, and a pixel without any counts as bent."""
    cv2, k = opencv(), REACH_PX
    known = np.where(seen, disparity, np.float32(np.nan))
    padded, (h, w) = np.pad(known, k, constant_values=np.nan), disparity.shape
    along_row = np.abs(known - 0.5 * (padded[k : k + h, :w] + padded[k : k + h, 2 * k :]))
    along_column = np.abs(known - 0.5 * (padded[:h, k : k + w] + padded[2 * k :, k : k + w]))
    bend = np.nan_to_num(np.fmax(along_row, along_column), nan=2.0 * MOST_BEND_PX)
    return np.asarray(cv2.dilate(bend, np.ones((2 * k + 1, 2 * k + 1))), np.float32)
