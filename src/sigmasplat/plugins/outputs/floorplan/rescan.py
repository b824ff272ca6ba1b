"""Find the regions of a floor plan to scan again: not observed, mapped too thinly, or uncertain."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from skimage.draw import polygon

from sigmasplat.api import Matrix
from sigmasplat.plugins.outputs.floorplan.ground import WRONG_BY

UNOBSERVED, FLOOR_UNOBSERVED, FREE, OBJECT, WALL = range(5)
"""Kinds of cells. FLOOR_UNOBSERVED: a ray passed above the cell, but its floor was not observed."""
MAX_DEPTH_SIGMA_M = 0.05
MAX_WRONG_SHARE = 0.5
"""The largest share of pixels whose colour is expected to be wrong."""
MIN_ALPHA = 0.9
"""As for surface fusion: below this alpha a surface is partly transparent."""
MIN_AREA_M2 = 0.03
MAX_GAP_M = 0.3
"""A region that was not observed reaches at most this far beyond observed space: farther away there may be nothing."""
MAX_REGIONS = 12

Grid = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Describe = Callable[[Mask], str]
"""Describes a part of the cells of one reason in words."""


@dataclass(frozen=True, eq=False)
class RescanRegion:
    """One region to scan again.

    center_m (x, y): centre of the widest place, where a circle of radius_m fits; area_m2; why: unseen, thin or unsure;
    found: what was measured there, in words.
    """

    center_m: tuple[float, float]
    radius_m: float
    area_m2: float
    why: str
    found: str

    def sentence(self, area_unit: str = "m²") -> str:
        """Describe the region: why, what was measured, how large it is, and where it is relative to the start."""
        x_m, y_m = self.center_m
        side, along = "right" if x_m > 0 else "left", "ahead of" if y_m > 0 else "behind"
        where = f"{abs(x_m):.1f} m {side}, {abs(y_m):.1f} m {along} the start"
        return f"{self.why}: {self.found} · {self.area_m2:.2f} {area_unit} · {where}"


def unsure_rule(predicted_errors: bool) -> str:
    """Return a sentence that says when a region is unsure."""
    depth = f"{100.0 * MAX_DEPTH_SIGMA_M:g} cm"
    if predicted_errors:
        return (
            f"A region is unsure if the predicted error of depth is above {depth} (one standard deviation), or if more "
            f"than {100.0 * MAX_WRONG_SHARE:g} % of the pixels are expected wrong by more than {WRONG_BY:g} (colour, "
            "0 to 1)."
        )
    return "This run has no predicted errors (uncertainty.probes), so the plan does not say where its map is unsure."


def find_rescan_regions(
    kind: NDArray[np.uint8], alpha: Grid, depth_sigma_m: Grid, wrong_share: Grid, cell_m: float, origin_m: Matrix
) -> list[RescanRegion]:
    """Return at most `MAX_REGIONS` regions of at least `MIN_AREA_M2`, the largest first.

    kind, alpha, depth_sigma_m, wrong_share: cells of a plan [rows, columns] as in `FloorPlan`.
    """
    with np.errstate(invalid="ignore"):
        thin = np.asarray(alpha < MIN_ALPHA)
        deep, wrong = depth_sigma_m > MAX_DEPTH_SIGMA_M, wrong_share > MAX_WRONG_SHARE

    def unsure(at: Mask) -> str:
        depth = f"depth uncertain by {100.0 * np.nanmean(depth_sigma_m[at]):.0f} cm"
        color = f"{100.0 * np.nanmean(wrong_share[at]):.0f} % of the pixels expected wrong by more than {WRONG_BY:g}"
        return ", ".join(words for words, cause in ((depth, deep), (color, wrong)) if cause[at].any())

    floor_unobserved = kind == FLOOR_UNOBSERVED
    hidden = _hidden(kind == UNOBSERVED, (kind == FREE) | floor_unobserved, cell_m)
    reasons: list[tuple[str, Mask, Describe]] = [
        ("unseen", hidden, lambda at: "not observed"),
        ("unseen", floor_unobserved, lambda at: "floor not observed"),
        ("thin", thin, lambda at: f"surface {100.0 * (1.0 - np.nanmean(alpha[at])):.0f} % transparent"),
        ("unsure", np.asarray((deep | wrong) & ~thin), unsure),
    ]
    found = []
    for why, mask, describe in reasons:
        labels, count = ndimage.label(_open(mask), np.ones((3, 3)))
        for number in range(1, count + 1):
            at = labels == number
            area_m2 = float(at.sum()) * cell_m**2
            if area_m2 >= MIN_AREA_M2:
                (row, column), radius = _widest_place(at)
                center = (float(origin_m[0] + (column + 0.5) * cell_m), float(origin_m[1] + (row + 0.5) * cell_m))
                found.append(RescanRegion(center, radius * cell_m, area_m2, why, describe(at)))
    return sorted(found, key=lambda region: -region.area_m2)[:MAX_REGIONS]


def _open(mask: Mask) -> Mask:
    """Close gaps of one cell, then drop parts that are only one cell wide."""
    closed = ndimage.binary_closing(np.pad(mask, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    return np.asarray(ndimage.binary_opening(closed, np.ones((2, 2), bool)))


def _widest_place(mask: Mask) -> tuple[tuple[float, float], float]:
    """Return row and column of the centre of the largest circle inside the mask, and its radius in cells.

    The candidates are all centres whose radius is within half a cell of the largest. The result is their mean if the
    mean is a candidate, else the candidate nearest to the mean.
    """
    inside = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    places = np.argwhere(inside >= inside.max() - 0.5)
    middle = places.mean(0)
    nearest = places[((places - middle) ** 2).sum(1).argmin()]
    row, column = middle if np.abs(nearest - middle).max() <= 0.5 else nearest
    return (float(row), float(column)), float(inside.max()) - 0.5


def _hidden(unobserved: Mask, empty: Mask, cell_m: float) -> Mask:
    """Return the unobserved cells inside the convex hull of observed cells and at most `MAX_GAP_M` from empty space.

    The distance is measured through unobserved cells only, so that space behind a wall does not count.
    """
    inside = unobserved & _hull(~unobserved)
    frontier = inside & ndimage.binary_dilation(empty)
    if not frontier.any():
        return frontier
    return np.asarray(ndimage.binary_dilation(frontier, iterations=max(1, round(MAX_GAP_M / cell_m)), mask=inside))


def _hull(cells: Mask) -> Mask:
    out, places = np.zeros_like(cells), np.argwhere(cells)
    try:
        corners = places[ConvexHull(places).vertices]
    except (QhullError, ValueError):
        return out
    inside: Callable[..., tuple[NDArray[np.intp], NDArray[np.intp]]] = polygon
    out[inside(corners[:, 0], corners[:, 1], cells.shape)] = True
    return out
