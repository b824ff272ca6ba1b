"""Find what has moved in front of the camera: surfaces in space that the reference saw to be free.

A surface that is nearer than the known one is not enough: a still one comes into view beside a farther one whenever the
camera moves. But then its place was hidden or outside the earlier view. Something that moved in is where the earlier
view saw through.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, minimum_filter

from sigmasplat.model.camera import Camera
from sigmasplat.types import Matrix

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]

STEP = 2
"""Every second row and column of the live image is tested."""
CLEAR_M, CLEAR_RELATIVE = 0.05, 0.05
"""A place was free if the reference saw a surface farther than it by this distance plus this share of its depth."""
AROUND_PX = 5
"""Size of the window around a pixel of the reference in which all readings must be farther: the pose is not exact."""
EDGE_RELATIVE = 0.05
"""A depth step, where a region ends: neighbouring pixels differ by more than this share of the nearer depth."""
LEAST_REGION, LEAST_SHARE = 0.005, 0.3
"""A region is in front if at least this share of the image's pixels, and of its own, are in places that were free."""
MARGIN_PX = 3
"""The mask is wider than the regions by this much: sensors mix depth and colour at an edge."""


@dataclass(frozen=True, eq=False)
class Foreground:
    """What is in front in an image: the pixels to ignore [H, W], with a margin, and its depth [H, W] m, 0 elsewhere."""

    hidden: Mask
    depth_m: Depth


def foreground(
    reference_m: Depth, before: Foreground | None, live_m: Depth, camera: Camera, T_reference_live: Matrix
) -> Foreground | None:
    """Find what has moved in front of the camera since a reference; None without.

    reference_m [H, W]: depth of the reference, 0 where it is not known; before: what was in front in the reference
    already; live_m [H, W]: live depth, both in metres, 0 = no reading; T_reference_live [4, 4]. A whole region between
    depth steps is in front, also its part whose place the reference did not see, but not pixels that fit to the
    reference.
    """
    depth = live_m[::STEP, ::STEP]
    depth = np.where(depth > 0, depth, maximum_filter(depth, 3))  # fill scattered holes
    free, same = _places(reference_m, before, depth, camera, T_reference_live)
    nearest = minimum_filter(np.where(depth > 0, depth, np.float32(np.inf)), 3)
    regions, count = label((depth > 0) & ~same & (depth <= (1 + EDGE_RELATIVE) * nearest), np.ones((3, 3)))
    sizes, in_free = (np.bincount(regions[chosen], minlength=count + 1) for chosen in (regions > 0, free))
    chosen = (in_free >= LEAST_REGION * depth.size) & (in_free >= LEAST_SHARE * sizes)
    chosen[0] = False
    if not chosen.any():
        return None
    whole = np.repeat(np.repeat(chosen[regions], STEP, 0), STEP, 1)[: live_m.shape[0], : live_m.shape[1]]
    return Foreground(maximum_filter(whole, 2 * MARGIN_PX + 1), np.where(whole, live_m, np.float32(0.0)))


def _places(
    reference_m: Depth, before: Foreground | None, depth: Depth, camera: Camera, T_reference_live: Matrix
) -> tuple[Mask, Mask]:
    """Return which pixels of every STEP-th row and column are in places that the reference saw to be free, and which
    are on its surfaces."""
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    rays = np.stack([(STEP * u - camera.cx) / camera.fx, (STEP * v - camera.cy) / camera.fy, np.ones(len(u))])
    x, y, z = T_reference_live[:3, :3] @ (rays * z) + T_reference_live[:3, 3:]
    ahead = np.maximum(z, 1e-3)
    column, row = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = (z > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    v, u, z, row, column = v[inside], u[inside], z[inside], row[inside].astype(np.intp), column[inside].astype(np.intp)
    limit = CLEAR_M + CLEAR_RELATIVE * z
    farthest = maximum_filter(reference_m, AROUND_PX)[row, column]
    nearest = minimum_filter(np.where(reference_m > 0, reference_m, np.float32(np.inf)), AROUND_PX)[row, column]
    is_free = (farthest > 0) & (z < nearest - limit)
    is_same = (farthest > 0) & ~is_free & (z < farthest + limit)
    if before is not None:
        front = before.depth_m[row, column]
        again = (front > 0) & (z < front + limit)
        is_free, is_same = is_free | again, is_same & ~again
    free, same = np.zeros((2, *depth.shape), bool)
    free[v, u], same[v, u] = is_free, is_same
    return free, same
