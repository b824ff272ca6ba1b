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

MAX_DEPTH_SIGMA_M = 0.05
MAX_WRONG_SHARE = 0.5
"""With predicted errors: the largest share of pixels whose colour is expected to be wrong."""
MAX_COLOR_SIGMA_RATIO = 3.0
"""Without predicted errors: relative to the median of the plan, because the size of σ depends on the training."""
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


@dataclass(frozen=True, eq=False)
class RescanMaps:
    """Maps of a plan [rows, columns] that show where to scan again.

    unobserved, floor_unobserved, free: cells of these kinds; the measurements are nan in cells without a surface.
    wrong_share: as in `FloorPlan`; None without predicted errors.
    """

    unobserved: Mask
    floor_unobserved: Mask
    free: Mask
    color_sigma: Grid
    depth_sigma_m: Grid
    alpha: Grid
    wrong_share: Grid | None = None


def unsure_rule(predicted_errors: bool) -> str:
    """Return a sentence that says when a region is unsure."""
    depth = f"{100.0 * MAX_DEPTH_SIGMA_M:g} cm"
    if predicted_errors:
        return (
            f"A region is unsure if the predicted error of depth is above {depth} (one standard deviation), or if more "
            f"than {100.0 * MAX_WRONG_SHARE:g} % of the pixels are expected wrong by more than {WRONG_BY:g} (colour, "
            "0 to 1)."
        )
    return (
        "This run has no predicted errors (uncertainty.probes), so a region is unsure if splats along a ray are more "
        f"than {depth} apart, or if their learned colour deviation is {MAX_COLOR_SIGMA_RATIO:g} times the median."
    )


def find_rescan_regions(maps: RescanMaps, cell_m: float, origin_m: Matrix) -> list[RescanRegion]:
    """Return at most `MAX_REGIONS` regions of at least `MIN_AREA_M2`, the largest first."""
    found = []
    for why, mask, describe in _reasons(maps, cell_m):
        labels, count = ndimage.label(_open(mask), np.ones((3, 3)))
        for number in range(1, count + 1):
            at = labels == number
            area_m2 = float(at.sum()) * cell_m**2
            if area_m2 >= MIN_AREA_M2:
                (row, column), radius = _widest_place(at)
                center = (float(origin_m[0] + (column + 0.5) * cell_m), float(origin_m[1] + (row + 0.5) * cell_m))
                found.append(RescanRegion(center, radius * cell_m, area_m2, why, describe(at)))
    return sorted(found, key=lambda region: -region.area_m2)[:MAX_REGIONS]


def _reasons(maps: RescanMaps, cell_m: float) -> list[tuple[str, Mask, Describe]]:
    """Return for each reason its name, its cells, and a function that describes a part of these cells."""
    with np.errstate(invalid="ignore"):
        thin = np.asarray(maps.alpha < MIN_ALPHA)
    unsure, describe_unsure = _unsure(maps) if maps.wrong_share is None else _unsure_predicted(maps, maps.wrong_share)
    return [
        (
            "unseen",
            _hidden(maps.unobserved, maps.free | maps.floor_unobserved, cell_m),
            lambda at: "not observed",
        ),
        ("unseen", maps.floor_unobserved, lambda at: "floor not observed"),
        ("thin", thin, lambda at: f"surface {100.0 * (1.0 - np.nanmean(maps.alpha[at])):.0f} % transparent"),
        ("unsure", np.asarray(unsure & ~thin), describe_unsure),
    ]


def _unsure_predicted(maps: RescanMaps, wrong_share: Grid) -> tuple[Mask, Describe]:
    """Return the cells with a large predicted error, and a function that describes a part of them."""
    with np.errstate(invalid="ignore"):
        of_depth, of_color = maps.depth_sigma_m > MAX_DEPTH_SIGMA_M, wrong_share > MAX_WRONG_SHARE

    def describe(at: Mask) -> str:
        depth = f"depth uncertain by {100.0 * np.nanmean(maps.depth_sigma_m[at]):.0f} cm"
        share = 100.0 * np.nanmean(wrong_share[at])
        color = f"{share:.0f} % of the pixels expected wrong by more than {WRONG_BY:g}"
        return ", ".join(words for words, cause in ((depth, of_depth), (color, of_color)) if cause[at].any())

    return np.asarray(of_depth | of_color), describe


def _unsure(maps: RescanMaps) -> tuple[Mask, Describe]:
    """Return the cells with a large spread of depth or a large σ, and a function that describes a part of them."""
    median_sigma = float(np.nanmedian(maps.color_sigma)) if np.isfinite(maps.color_sigma).any() else 1.0
    with np.errstate(invalid="ignore"):
        of_depth = maps.depth_sigma_m > MAX_DEPTH_SIGMA_M
        of_color = maps.color_sigma > MAX_COLOR_SIGMA_RATIO * median_sigma

    def describe(at: Mask) -> str:
        depth = f"depth ± {100.0 * np.nanmean(maps.depth_sigma_m[at]):.1f} cm"
        color = f"colour uncertainty {np.nanmean(maps.color_sigma[at]) / median_sigma:.1f} times the median"
        return ", ".join(words for words, cause in ((depth, of_depth), (color, of_color)) if cause[at].any())

    return np.asarray(of_depth | of_color), describe


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
    """Return the convex hull of cells."""
    out, places = np.zeros_like(cells), np.argwhere(cells)
    try:
        corners = places[ConvexHull(places).vertices]
    except (QhullError, ValueError):
        return out
    inside: Callable[..., tuple[NDArray[np.intp], NDArray[np.intp]]] = polygon
    out[inside(corners[:, 0], corners[:, 1], cells.shape)] = True
    return out
