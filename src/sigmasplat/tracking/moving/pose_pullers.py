"""Find the thing that has pulled a pose: it moves, and the images agree much better without it."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit.align import align
from sigmasplat.fit.compare import STEP as COMPARE_STEP
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
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
rest of the image gains at least `QUICK_GAIN` (`gray_gain`) and gain × shift is at least `QUICK_APART`.
The share of close depths may fall by `QUICK_CLOSE`: poses from small images are not more exact."""
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
            if not is_scene(thing, live_m):
                yield thing


def is_scene(thing: DynamicMask, depth_m: Depth) -> bool:
    """Return whether a thing hides more than half of the readings [H, W]."""
    return bool(np.count_nonzero(depth_m[thing.hidden]) > OBJECT_SHARE[1] * np.count_nonzero(depth_m))


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

    The rest agrees much more there, the thing does not agree with it, and the pulled pose is not only a poor fit.
    contradicted: the images contradict the pulled pose.
    """
    if keyframe is None or _shift(thing, seen, drawn.T_camera_world, found.T_camera_world) < SHIFTED:
        return False
    if not agrees_more(found.comparison, drawn.comparison, contradicted):
        return False
    if not disagrees(keyframe.compared(seen.live, found.T_camera_world), found.comparison):
        return False
    return contradicted or not _fits_poorly(thing, keyframe, seen, drawn, found)


def _shift(thing: DynamicMask, seen: PreparedFrame, T_first: Matrix, T_second: Matrix) -> float:
    """Return by how much a thing is shifted between two poses T_camera_world [4, 4], as a share of the image width."""
    return shift_px(thing, seen.target.camera, T_first @ se3.inverse(T_second)) / seen.target.camera.width


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
