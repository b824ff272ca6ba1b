"""Find the thing that has pulled a pose: the rest of the image gives another pose, further away than errors explain.

Both tests are those of a misfit that only part of the data has (Hausman 1978). Before a fit: at the pose that all
pixels agree on, the gradient of the rest is not 0 (a score test). After it: the pose fitted without the thing is
further away than its covariance says.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from sigmasplat.data import se3
from sigmasplat.fit.align import Alignment, normal_equations
from sigmasplat.fit.pose import PoseFit
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask, enlarged, smooth, thinned, with_margin
from sigmasplat.tracking.moving.free_space import CLEAR_RELATIVE, Depth, Mask, labelled, upper_median, widened
from sigmasplat.tracking.pose_validation import wrong_odds
from sigmasplat.tracking.prepared_frame import PreparedFrame

OBJECT_SHARE, MOST_OBJECTS = (0.02, 0.5), 3
"""Share of the readings that a thing hides, and how many things are considered. What hides more than half of them is
the scene: the motion of the camera is that of most of the image."""
RING, FREE_AROUND = 3, 0.6
"""Something stands free if at least this share of the pixels at this distance around it is farther."""
LEVEL, CELL, FEWEST_CELLS = 1e-3, 256, 12
"""A thing is suspected if the test that nothing moves is rejected at this level, by the scatter of the gradient over
cells of so many pixels (native/align.h), if there are enough cells."""
SHRINKS, PULLED = 0.01, 225.0
"""A thing has pulled the pose if χ², with 6 degrees of freedom, is above the second value, ten times what independent
errors exceed in 0.1 % of cases: covariances of alignment are that much too small. They do not contain that alignment of
noisy images shrinks motions, by about the first value as a share. The limit grows with the odds that the other pose is
wrong, relative to those of the first one."""


def suspected(seen: PreparedFrame, fit: PoseFit) -> Iterator[DynamicMask]:
    """Yield the things that stand free in front, at most half of the readings, and may have pulled a pose."""
    if fit.alignment is None:
        return
    live_m = seen.target.depth_image.numpy()
    for inside in free_standing(thinned(live_m)):
        if rest_disagrees(fit.alignment, with_margin(inside, live_m)[1]):
            thing = thing_of(inside, live_m)
            if not is_scene(thing, live_m):
                yield thing


def thing_of(inside: Mask, live_m: Depth) -> DynamicMask:
    """Return what stands free, from its pixels in `thinned` depth; what is behind it is not known."""
    whole, hidden = enlarged(inside, live_m)
    return DynamicMask(hidden, np.where(whole, live_m, np.float32(0.0)), np.where(hidden, np.float32(0.0), live_m))


def is_scene(thing: DynamicMask, depth_m: Depth) -> bool:
    """Return whether a thing hides more than half of the readings [H, W]."""
    return bool(np.count_nonzero(depth_m[thing.hidden]) > OBJECT_SHARE[1] * np.count_nonzero(depth_m))


def rest_disagrees(found: Alignment, hidden: Mask) -> bool:
    """Return whether the image without some pixels [H, W] has a gradient at the pose that was found with them (T² test
    of Hotelling, over cells)."""
    reference, live = found.pair.reference.finest(), found.pair.live.finest().hiding(hidden)
    rest = replace(found.pair, reference=reference, live=live)
    n = normal_equations(rest.kernels, rest.level(0), [found.T_live_reference])[0]
    cells = n.sums[1] / CELL
    if cells < FEWEST_CELLS:
        return False
    # χ² / cells, from the scatter of the cells about 0; the ratio below is that from the scatter about their mean
    share = min(float(n.b @ np.linalg.lstsq(n.S, n.b)[0]) / cells, 1.0 - 1e-9)
    return bool(share / (1.0 - share) * (cells - 6.0) / 6.0 > fdtri(6.0, cells - 6.0, 1.0 - LEVEL))


def has_pulled(fit: PoseFit, without: PoseFit) -> bool:
    """Return whether a thing has pulled a pose, by a fit without it: the pose is another one, and not much more likely
    wrong."""
    if fit.comparison is None or without.comparison is None or without.alignment is None:
        return False
    away, found = se3.log(fit.T_camera_world @ se3.inverse(without.T_camera_world)), without.alignment
    motion = np.linalg.norm(se3.log(found.T_live_reference).reshape(2, 3), axis=1)
    covariance = found.covariance + np.diag(found.bias**2 + np.repeat(SHRINKS * motion, 3) ** 2)
    if not np.isfinite(covariance).all():
        return False
    odds = wrong_odds(without.comparison) / wrong_odds(fit.comparison)
    return bool(away @ np.linalg.solve(covariance, away) > PULLED * odds)


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
    far_m = upper_median(near_m[inside]) * (1 + CLEAR_RELATIVE)
    ring = widened(inside, 2 * RING + 1) & ~widened(inside, 2 * RING - 1) & (near_m > 0)
    return bool(ring.any()) and bool((near_m[ring] > far_m).mean() >= FREE_AROUND)
