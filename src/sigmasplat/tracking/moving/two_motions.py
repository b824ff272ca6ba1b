"""Tell two motions apart: where a frame agrees better with a keyframe at one pose of the camera, where at another."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.env import opencv
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.tracking.moving.dynamic_mask import coarse_rays
from sigmasplat.types import Matrix

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

LEVEL, STEP = 1, 2
"""Every second row and column of images of half the size is compared."""
SMOOTH = 2.0
"""Standard deviation of the window in which points vote, in compared points."""
MOST_GRAY = 0.15
"""Largest gray difference that counts: a larger one is another surface."""
CLOSE_M, CLOSE_RELATIVE = 0.02, 0.06
"""A point is compared if the frame has the same surface there: within a distance that grows with the depth."""
FEWEST = 100
"""Two poses are not compared with fewer points in common."""
REST_GAINS, THING_LOSES, LEAST_MOVES = 1.5, 1.2, 0.02
"""Least factors of the squared gray differences, and least share of the compared points that move."""
MOST_OF_REST = 0.7
"""Least share of the rest of the image that agrees better at the second pose. If a still thing is left out, the second
pose follows the moving thing instead. That thing's squared differences can outweigh those of the whole rest, but it
covers a smaller part of the image."""


class TwoMotions(NamedTuple):
    """How the gray values of a frame agree with a keyframe at two poses.

    rest_gains: the squared differences outside of the thing at the first pose, relative to the second; thing_loses:
    those of the parts of the thing that agree better at the first pose, at the second pose relative to the first;
    moves: the share of these parts in the compared points; follows: the share of the points outside of the thing that
    agree better at the second pose.
    """

    rest_gains: float
    thing_loses: float
    moves: float
    follows: float

    @property
    def apart(self) -> bool:
        """Return whether thing and rest move differently: each agrees clearly better at a pose of its own."""
        gains = self.rest_gains >= REST_GAINS and self.thing_loses >= THING_LOSES
        return gains and self.moves >= LEAST_MOVES and self.follows >= MOST_OF_REST


def two_motions(
    keyframe: Reference, live: Pyramid, thing: Mask, T_first: Matrix, T_second: Matrix
) -> TwoMotions | None:
    """Compare a frame with a keyframe at two poses T_camera_world [4, 4], in and outside of a thing [H, W]; None if too
    little is in view at both."""
    p = keyframe.pyramid
    level = min(LEVEL, len(p.cameras) - 1)
    points_m = (
        np.moveaxis(coarse_rays(p.cameras[level], STEP), -1, 0) * p.kernels.to_host(p.depth[level])[::STEP, ::STEP]
    )
    (first, row, column), (second, _, _) = (
        _differences(p, level, points_m, live, T @ se3.inverse(keyframe.T_camera_world)) for T in (T_first, T_second)
    )
    seen = np.isfinite(first) & np.isfinite(second)
    if np.count_nonzero(seen) < FEWEST:
        return None
    inside = seen & thing[row, column]
    rest, at_first, at_second = seen & ~inside, _voted(first, seen), _voted(second, seen)
    moving = inside & (at_first < at_second)
    return TwoMotions(
        rest_gains=_ratio(first[rest], second[rest]),
        thing_loses=_ratio(second[moving], first[moving]),
        moves=np.count_nonzero(moving) / seen.size,
        follows=float((at_second < at_first)[rest].mean()) if rest.any() else 0.0,
    )


def _differences(
    p: Pyramid, level: int, points_m: Matrix, live: Pyramid, T: Matrix
) -> tuple[Image, NDArray[np.intp], NDArray[np.intp]]:
    """Compare points [3, h, w] (m) of a level of a reference with a live image at T_live_reference [4, 4]. Return the
    squared gray differences [h, w], NaN where they are not seen; row and column in pixels of the finest level."""
    host = p.kernels.to_host
    camera, gray = p.cameras[level], host(p.gray[level])[::STEP, ::STEP]
    x, y, ahead = np.tensordot(T[:3, :3], points_m, 1) + T[:3, 3][:, None, None]
    depth = np.maximum(ahead, 1e-3)
    at = [(f * a / depth + c).astype(np.float32) for f, a, c in ((camera.fx, x, camera.cx), (camera.fy, y, camera.cy))]
    inside = (
        (at[0] >= 0) & (at[1] >= 0) & (at[0] <= camera.width - 1) & (at[1] <= camera.height - 1) & (points_m[2] > 0)
    )
    cv2 = opencv()
    there = cv2.remap(host(live.gray[level]), *at, cv2.INTER_LINEAR)
    live_m = cv2.remap(host(live.depth[level]), *at, cv2.INTER_NEAREST)
    same = inside & (live_m > 0) & (np.abs(live_m - ahead) < CLOSE_M * p.scene_scale + CLOSE_RELATIVE * ahead)
    difference = there - gray
    difference -= np.median(difference[same]) if same.any() else 0.0
    square = np.where(same, np.minimum(difference**2, MOST_GRAY**2), np.nan).astype(np.float32)
    finest = live.cameras[0]
    ends = (finest.width - 1, finest.height - 1)
    column, row = (np.clip(2**level * (a + 0.25), 0, end).astype(np.intp) for a, end in zip(at, ends, strict=True))
    return square, row, column


def _voted(square: Image, seen: Mask) -> Image:
    """Return the sum of squared differences in a window around each point."""
    return np.asarray(opencv().GaussianBlur(np.where(seen, square, np.float32(0.0)), (0, 0), SMOOTH), np.float32)


def _ratio(a: Image, b: Image) -> float:
    return float(a.sum(dtype=np.float64) / max(b.sum(dtype=np.float64), 1e-12)) if len(a) else 0.0
