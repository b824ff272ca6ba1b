"""Find the thing that has pulled a pose: it moves, and the images agree much better without it."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
from sigmasplat.fit.align import align
from sigmasplat.fit.compare import STEP as COMPARE_STEP
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Image
from sigmasplat.tracking.moving.dynamic_mask import (
    EDGE_RELATIVE,
    STEP,
    DynamicMask,
    coarse_rays,
    enlarged,
    smooth,
    thinned,
    with_margin,
)
from sigmasplat.tracking.moving.free_space import Depth, Mask, labelled, upper_median, widened
from sigmasplat.tracking.pose_validation import agrees_more, differs, disagrees, gray_gain, may_draw
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.types import Matrix

OBJECT_SHARE, MOST_OBJECTS = (0.02, 0.5), 3
"""Share of the readings that a thing hides, and how many things are considered. What hides more than half of them is
the scene: the motion of the camera is that of most of the image."""
RING, FREE_AROUND = 3, 0.6
"""Something stands free if at least this share of the pixels at this distance around it is farther."""
SHIFTED = 1e-3
"""A thing has pulled the pose only if the pose fitted without it shifts the thing by at least this share of the width
of the image. A thing that stays in place and only changes its brightness shifts less."""
QUICK_LEVELS, QUICK_GAIN, QUICK_APART, QUICK_CLOSE = 2, 0.5, 2.5e-3, 5e-3
"""The quick check fits the pose without a thing, on the `QUICK_LEVELS` coarsest images. The thing is suspected if the
rest of the image gains at least `QUICK_GAIN` (`gray_gain`) and gain × shift is at least `QUICK_APART`, half of `APART`.
The share of close depths may fall by `QUICK_CLOSE`: poses from small images are not more exact."""
APART = 5e-3
"""Two motions are apart if the shift of the thing, as a share of the width of the image, times the gain of the rest
above 1 is at least this. In still recordings it was at most 0.2 %, and for balls in real recordings more than 1 %: a
poor fit gains little, or moves the thing little."""
STILL_SHOWN, STILL_CLOSE = 0.5, 0.8
"""A thing is still if the keyframe shows at least this share of it, and this share of that is as far as before."""
SHIFT_STEP = 4
"""Every fourth row and column of a thing is used to find this shift."""


def suspected(
    keyframe: Reference, seen: PreparedFrame, fit: PoseFit, config: TrackingConfig, every: bool
) -> Iterator[DynamicMask]:
    """Yield the things in front that may have pulled a pose; with `every`, all that stand free. None hides most of the
    readings."""
    live_m = seen.target.depth_image.numpy()
    for inside in free_standing(thinned(live_m, STEP)):
        if every or _may_have_drawn(_front(*with_margin(inside, STEP, live_m), live_m), keyframe, seen, fit, config):
            thing = _front(*enlarged(inside, STEP, live_m), live_m)
            if np.count_nonzero(live_m[thing.hidden]) <= OBJECT_SHARE[1] * np.count_nonzero(live_m):
                yield thing


def _may_have_drawn(
    thing: DynamicMask, keyframe: Reference, seen: PreparedFrame, fit: PoseFit, config: TrackingConfig
) -> bool:
    """Return whether the gray values agree better without a thing, at the same pose or at one that an alignment of
    small images finds, where the depth agrees as well."""
    rest = seen.hiding(thing)
    here = keyframe.compared(rest, fit.T_camera_world)
    if may_draw(here, fit.comparison):
        return True
    small, guess = keyframe.pyramid.coarse(QUICK_LEVELS), fit.T_camera_world @ se3.inverse(keyframe.T_camera_world)
    found = align(small, rest.coarse(QUICK_LEVELS), guess, weight_color=config.align_weight_color)
    T_camera_world = found.T_live_reference @ keyframe.T_camera_world
    there = keyframe.compared(rest, T_camera_world)
    gain = gray_gain(here, there)
    if not gain >= QUICK_GAIN or there.close < here.close - QUICK_CLOSE:
        return False
    shift = _shift(thing, seen, fit.T_camera_world, T_camera_world)
    return shift >= SHIFTED and gain * shift >= QUICK_APART


def _front(whole: Mask, hidden: Mask, live_m: Depth) -> DynamicMask:
    """Return a thing that stands free, from its pixels and those that it hides; what is behind it is not known."""
    return DynamicMask(hidden, np.where(whole, live_m, np.float32(0.0)), np.where(hidden, np.float32(0.0), live_m))


def free_standing(depth: Depth) -> Iterator[Mask]:
    """Yield the things that stand free in `thinned` depth [h, w], m, in front of farther surfaces all around, as masks
    [h, w]: the largest first, at most `MOST_OBJECTS`."""
    regions, boxes = labelled(smooth(depth))
    sizes, found = boxes[:, -1] / max(int(np.count_nonzero(depth)), 1), 0
    for region in np.argsort(-sizes, kind="stable"):
        if sizes[region] < OBJECT_SHARE[0] or found == MOST_OBJECTS:
            break
        if sizes[region] <= OBJECT_SHARE[1] and _stands_free(depth, regions, region + 1, boxes[region]):
            found += 1
            yield regions == region + 1


def _stands_free(depth: Depth, regions: NDArray[np.int32], region: int, box: NDArray[np.int32]) -> bool:
    """Return whether most of what is around a region of depth [h, w], m, is farther; box: of `labelled`."""
    left, top, width, height, _ = box.tolist()
    around = slice(max(top - RING, 0), top + height + RING), slice(max(left - RING, 0), left + width + RING)
    near_m, inside = depth[around], regions[around] == region
    far_m = upper_median(near_m[inside]) * (1 + EDGE_RELATIVE)
    ring = widened(inside, 2 * RING + 1) & ~widened(inside, 2 * RING - 1) & (near_m > 0)
    return bool(ring.any()) and bool((near_m[ring] > far_m).mean() >= FREE_AROUND)


def has_drawn(
    thing: DynamicMask,
    keyframe: Reference | None,
    seen: PreparedFrame,
    drawn: PoseFit,
    found: PoseFit,
    contradicted: bool,
) -> bool:
    """Return whether a thing has pulled a pose, by the pose that was fitted without it, which shows it elsewhere.

    Either the rest agrees much more there and the thing does not agree with it, or each of the two agrees clearly
    better at a pose of its own. contradicted: the images contradict the pulled pose.
    """
    shift = _shift(thing, seen, drawn.T_camera_world, found.T_camera_world)
    if keyframe is None or shift < SHIFTED:
        return False
    if _disturbs(thing, keyframe, seen, drawn, found, contradicted):
        return True
    motions = two_motions(keyframe, seen.live, thing.hidden, drawn.T_camera_world, found.T_camera_world)
    return motions is not None and motions.apart and (motions.rest_gains - 1.0) * shift >= APART


def _shift(thing: DynamicMask, seen: PreparedFrame, T_first: Matrix, T_second: Matrix) -> float:
    """Return by how much a thing is shifted between two poses T_camera_world [4, 4], as a share of the image width."""
    return shift_px(thing, seen.target.camera, T_first @ se3.inverse(T_second)) / seen.target.camera.width


def _disturbs(
    thing: DynamicMask, keyframe: Reference, seen: PreparedFrame, drawn: PoseFit, found: PoseFit, contradicted: bool
) -> bool:
    """Return whether the rest agrees much more without a thing, the thing does not agree with the rest, and the pulled
    pose is not only a poor fit."""
    if not agrees_more(found.comparison, drawn.comparison, contradicted):
        return False
    if not disagrees(keyframe.compared(seen.live, found.T_camera_world), found.comparison):
        return False
    return contradicted or not _fits_poorly(thing, keyframe, seen, drawn, found)


def _fits_poorly(thing: DynamicMask, keyframe: Reference, seen: PreparedFrame, drawn: PoseFit, found: PoseFit) -> bool:
    """Return whether the first pose is only a poor fit: the rest agrees hardly better there than with the thing, and
    the thing itself agrees better at the other pose."""
    alone = seen.live.hiding(thing.depth_m <= 0)
    at_drawn, at_found = (keyframe.compared(alone, fit.T_camera_world).correlation for fit in (drawn, found))
    rest = keyframe.compared(seen.hiding(thing), drawn.T_camera_world)
    return at_found > at_drawn and not may_draw(rest, drawn.comparison)


def is_still(thing: DynamicMask, keyframe: Reference | None, live: Pyramid, found: PoseFit) -> bool:
    """Return whether what may be in front belongs to the scene: the keyframe shows most of it at the same place, with
    gray values that agree as well as those of the rest."""
    if keyframe is None or found.comparison is None:
        return False
    shown = keyframe.compared(live.hiding(thing.depth_m <= 0), found.T_camera_world)
    whole = np.count_nonzero(thing.depth_m) / COMPARE_STEP**2
    in_place = bool(shown.points >= STILL_SHOWN * whole and shown.close >= STILL_CLOSE)
    return in_place and not (differs(shown) and disagrees(shown, found.comparison))


def shift_px(thing: DynamicMask, camera: Camera, T_b_a: Matrix) -> float:
    """Return by how many pixels a thing that camera a sees is shifted in camera b [4, 4]: the median of its pixels."""
    depth = thing.depth_m[::SHIFT_STEP, ::SHIFT_STEP]
    v, u = np.nonzero(depth > 0)
    if not len(u):
        return 0.0
    rays = coarse_rays(camera, SHIFT_STEP)[v, u].T
    x, y, z = T_b_a[:3, :3] @ (rays * depth[v, u]) + T_b_a[:3, 3:]
    ahead = np.maximum(z, 1e-3)
    return float(np.median(np.hypot(camera.fx * (x / ahead - rays[0]), camera.fy * (y / ahead - rays[1]))))


# ---- two motions: where a frame agrees better at one pose of the camera, where at another ----

COMPARED_LEVEL, COMPARED_STEP = 1, 2
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
    level = min(COMPARED_LEVEL, len(p.cameras) - 1)
    depth_m = p.kernels.to_host(p.depth[level])[::COMPARED_STEP, ::COMPARED_STEP]
    points_m = np.moveaxis(coarse_rays(p.cameras[level], COMPARED_STEP), -1, 0) * depth_m
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
    camera, gray = p.cameras[level], host(p.gray[level])[::COMPARED_STEP, ::COMPARED_STEP]
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
