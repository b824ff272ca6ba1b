"""Find what has moved in front of the camera: surfaces in space that the reference saw to be free.

A surface that is nearer than the known one is not enough: a still one comes into view beside a farther one whenever the
camera moves. But then its place was hidden or outside the earlier view. Something that moved in is where the earlier
view saw through.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.tracking.moving.free_space import (
    AROUND_PX,
    CLEAR_M,
    CLEAR_RELATIVE,
    Depth,
    Mask,
    free_places,
    labelled,
    largest_around,
    largest_label,
    least_around,
    on_image,
    upper_median,
    widened,
)
from sigmasplat.types import Matrix

STEP, COLUMNS_TESTED = 2, 80
"""Every second row and column of the live image is tested; of images that are tested against many others, about so many
columns (`coarse_step`)."""
POSE_ERROR = 0.05
"""This share of the motion between both images is added to the window on each side: motion blur and calibration errors
grow with the motion."""
LEAST_REGION, LEAST_SHARE = 0.01, 0.15
"""A region is in front if at least this share of the image's pixels, and of its own, are in places that were free."""
WHOLE_SHARE = 0.05
"""The least share of a region that is an object by itself: an object that moves slowly covers most of its old place."""
SAME_THING = 0.6
"""A region is what was in front in the last image if at least this share of it is there."""
SURROUNDED = 0.75
"""A hole in depth belongs to what is in front if this share of its edge does."""
MARGIN_PX = 3
"""The mask is wider than the regions by this much: sensors mix depth and colour at an edge."""


@dataclass(frozen=True, eq=False)
class DynamicMask:
    """What is in front in an image.

    hidden [H, W]: the pixels that show it, with a margin; depth_m [H, W]: its depth, 0 elsewhere; scene_m [H, W]: depth
    of everything else, behind it as far as it is known from earlier images, else 0.
    """

    hidden: Mask
    depth_m: Depth
    scene_m: Depth


@dataclass(frozen=True, eq=False)
class Earlier:
    """Depth of an earlier image [H, W] m, 0 where it is not known, and its pose relative to a live camera, [4, 4].

    clear_m: surfaces are apart if they differ by so much plus a share of their depth; further_px: windows are larger by
    so many pixels on each side.
    """

    depth_m: Depth
    T_earlier_live: Matrix
    clear_m: float = CLEAR_M
    further_px: int = 0

    @property
    def far_m(self) -> Depth:
        """Return the largest reading in a window around each pixel, 0 without any."""
        return largest_around(self.depth_m, AROUND_PX + 2 * self.further_px)

    @property
    def range_m(self) -> tuple[Depth, Depth]:
        """Return the least (inf without any) and the largest reading (0 without any) in a window around each pixel."""
        return least_around(self.depth_m, AROUND_PX + 2 * self.further_px), self.far_m

    def within_error(self, live_m: Depth, camera: Camera) -> "Earlier":
        """Return the same with windows that grow with the motion between both images; live_m: live depth, m."""
        read = live_m[live_m > 0]
        if not len(read):
            return self
        moved_rad = se3.angle_between(np.eye(4), self.T_earlier_live, float(upper_median(read)))
        return replace(self, further_px=int(min(POSE_ERROR * camera.fx * moved_rad, camera.width)))


@lru_cache(maxsize=8)
def coarse_rays(camera: Camera, step: int) -> Matrix:
    """Return the rays of every `step`-th row and column of a camera [h, w, 3], float64."""
    return camera.rays()[::step, ::step].astype(np.float64)


def coarse_step(camera: Camera) -> int:
    """Return the step between the columns that are tested of images that are tested against many others."""
    return max(STEP, camera.width // COLUMNS_TESTED)


def thinned(live_m: Depth, step: int = STEP) -> Depth:
    """Return every `step`-th row and column of depth [H, W], m, without its scattered holes."""
    depth = live_m[::step, ::step]
    return np.where(depth > 0, depth, largest_around(depth, 3))


def dynamic_mask(
    scene: Earlier, before: Earlier | None, live_m: Depth, camera: Camera, whole_objects: bool = False, step: int = STEP
) -> DynamicMask | None:
    """Find what has moved in front of the camera; None without.

    scene: the reference; before: what was in front in the last image; live_m [H, W]: live depth, m. A whole region
    between depth steps is in front, also its part whose place the reference did not see, but not pixels that fit to the
    reference. With `whole_objects` these belong to it too, if the region is an object by itself: something that has
    moved by less than its size covers its own earlier place. step: of the rows and columns that are tested.
    """
    depth = thinned(live_m, step)
    scene = scene.within_error(depth, camera)
    free = _free(scene, depth, camera, step)
    if before is None and np.count_nonzero(free) < LEAST_REGION * depth.size:
        return None
    again, same = _places(scene, before, depth, free, camera, step)
    if np.count_nonzero(free | again) < LEAST_REGION * depth.size:
        return None
    inside = smooth(depth)
    moved = _regions(inside & ~same, free, again, whole_objects=False)
    if whole_objects:
        moved |= _regions(inside, free, again, whole_objects=True)
    if not moved.any():
        return None
    whole, hidden = enlarged(moved, live_m, step, whole_objects)
    scene_m = np.where(hidden, _behind(scene, camera, hidden), live_m)
    return DynamicMask(hidden, np.where(whole, live_m, np.float32(0.0)), scene_m)


def smooth(depth: Depth) -> Mask:
    """Return the pixels with a reading that are not on the far side of a depth step."""
    nearest = least_around(depth, 3)
    return np.asarray((depth > 0) & (depth <= (1 + CLEAR_RELATIVE) * nearest))


def enlarged(small: Mask, live_m: Depth, step: int = STEP, whole_objects: bool = True) -> tuple[Mask, Mask]:
    """Return a mask of every `step`-th pixel at the size of the image, and the same with a margin and with the holes in
    depth that it surrounds: what is too near for the sensor has no reading, but hides the scene too. whole_objects:
    what is as far as the edge of such a hole belongs to the same thing."""
    whole, hidden = with_margin(small, live_m, step)
    return whole, hidden | _holes_in(hidden, whole if whole_objects else None, live_m)


def with_margin(small: Mask, live_m: Depth, step: int = STEP) -> tuple[Mask, Mask]:
    """Return the same without the holes."""
    whole = np.repeat(np.repeat(small, step, 0), step, 1)[: live_m.shape[0], : live_m.shape[1]]
    return whole, widened(whole, 2 * MARGIN_PX + 1)


def _holes_in(mask: Mask, thing: Mask | None, depth_m: Depth) -> Mask:
    """Return the connected pixels without a reading whose edge is in the mask, at least a share of `SURROUNDED`.

    With `thing`, its own pixels, half of the edge is enough if the rest is as far as the thing at this hole: a rim
    between two holes is too thin to be a region. Then lines without readings, as at outlines, join no holes.
    """
    unread = depth_m <= 0
    holes, boxes = labelled(unread if thing is None else ~widened(~unread, 3))
    count = len(boxes)
    holes = holes if thing is None else largest_label(holes, count) * unread
    beside = largest_label(holes, count)
    edge = np.flatnonzero((beside > 0) & ~unread)
    hole, in_mask, z = beside.ravel()[edge], mask.ravel()[edge], depth_m.ravel()[edge].astype(np.float64)
    edges, covered = (np.bincount(found, minlength=count + 1) for found in (hole, hole[in_mask]))
    own = (edges > 0) & (covered >= SURROUNDED * edges)
    if thing is not None:
        near, far, of_thing = np.full(count + 1, np.inf), np.zeros(count + 1), thing.ravel()[edge]
        np.minimum.at(near, hole[of_thing], z[of_thing])
        np.maximum.at(far, hole[of_thing], z[of_thing])
        reach = 1 + CLEAR_RELATIVE
        alike = in_mask | ((z * reach >= near[hole]) & (z <= far[hole] * reach))
        own |= (2 * covered >= edges) & (np.bincount(hole[alike], minlength=count + 1) >= SURROUNDED * edges)
    own[0] = False
    return np.take(own, holes) if own.any() else np.zeros_like(mask)


def _regions(inside: Mask, free: Mask, again: Mask, whole_objects: bool) -> Mask:
    """Return the connected regions of pixels that are in places which were free, or where something was before; with
    whole_objects, of which a small part is, or of which the larger part is where something was before."""
    regions, boxes = labelled(inside)
    count = len(boxes)
    sizes, in_free, old = (np.bincount(regions[chosen], minlength=count + 1) for chosen in (regions > 0, free, again))
    least, share = LEAST_REGION * free.size, WHOLE_SHARE if whole_objects else LEAST_SHARE
    chosen = (in_free >= least) & (in_free + old >= share * sizes)
    if whole_objects:
        chosen |= (sizes >= least) & (in_free + old >= SAME_THING * sizes)
    chosen[0] = False
    return np.asarray(chosen[regions])


def _behind(scene: Earlier, camera: Camera, hidden: Mask) -> Depth:
    """Return the scene as the live camera would see it at the hidden pixels, m, 0 where it is not known."""
    v, u = np.nonzero(scene.depth_m > 0)
    points = coarse_rays(camera, 1)[v, u].T * scene.depth_m[v, u]
    inside, row, column, z = projected(points, camera, se3.inverse(scene.T_earlier_live))
    found = np.flatnonzero(inside & widened(hidden, 3)[row, column])
    found = found[np.argsort(-z[found], kind="stable")]  # the nearest surface is written last
    seen = np.zeros(scene.depth_m.shape, np.float32)
    seen[row[found], column[found]] = z[found]
    return np.where(seen > 0, seen, largest_around(seen, 3))


def _free(scene: Earlier, depth: Depth, camera: Camera, step: int) -> Mask:
    """Return which pixels of every `step`-th row and column are in places that were free."""
    points_m = np.ascontiguousarray(coarse_rays(camera, step).reshape(-1, 3).T, np.float32) * depth.reshape(-1)
    free = free_places(points_m, scene.T_earlier_live, scene.depth_m, camera, scene.clear_m, scene.further_px)
    return np.asarray(free & (points_m[2] > 0)).reshape(depth.shape)


def _places(
    scene: Earlier, before: Earlier | None, depth: Depth, free: Mask, camera: Camera, step: int
) -> tuple[Mask, Mask]:
    """Return which of the pixels that are not in free places are where something was in front already, and which of the
    rest are on surfaces of the scene."""
    v, u = np.nonzero((depth > 0) & ~free)
    points = coarse_rays(camera, step)[v, u].T * depth[v, u]
    far = scene.far_m
    inside, row, column, z = projected(points, camera, scene.T_earlier_live)
    known, limit = inside & (far[row, column] > 0), scene.clear_m + CLEAR_RELATIVE * z
    again, same = np.zeros((2, *depth.shape), bool)
    if before is not None:
        in_last, at_row, at_column, z_last = projected(points, camera, before.T_earlier_live)
        front = before.depth_m[at_row, at_column]
        again[v, u] = in_last & (front > 0) & (z_last < front + scene.clear_m + CLEAR_RELATIVE * z_last)
    same[v, u] = known & (z < far[row, column] + limit)
    return again, same & ~again


def seen_again(scene: Earlier, depth: Depth, camera: Camera, step: int) -> tuple[Mask, Mask]:
    """Return which pixels of every `step`-th row and column [h, w], m, are in places that an earlier image shows, and
    which of these are on a surface of it."""
    v, u = np.nonzero(depth > 0)
    points = coarse_rays(camera, step)[v, u].T * depth[v, u]
    inside, row, column, z = projected(points, camera, scene.T_earlier_live)
    (near, far), limit = (plane[row, column] for plane in scene.range_m), scene.clear_m + CLEAR_RELATIVE * z
    known, same = np.zeros((2, *depth.shape), bool)
    known[v, u] = inside & (far > 0) & (z < far + limit)  # what is farther was hidden
    same[v, u] = known[v, u] & (z > near - limit)
    return known, same


def projected(
    points: Matrix, camera: Camera, T_earlier_live: Matrix
) -> tuple[Mask, NDArray[np.intp], NDArray[np.intp], Matrix]:
    """Project live points [3, n] into an earlier image: whether they are inside, row, column (0 outside), depth."""
    x, y, z = T_earlier_live[:3, :3] @ points + T_earlier_live[:3, 3:]
    return *on_image(x, y, z, camera), z
