"""Say where to scan again: what a floor plan is unsure of, has too little of, or never saw though it lies inside."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from skimage.draw import polygon

from sigmasplat.types import Matrix

UNSURE_DEPTH_M = 0.05
UNSURE_COLOR = 3.0
"""Times the plan's median: how large σ is as such depends on how the map was trained."""
THIN_ALPHA = 0.9
"""As for fusing surfaces: less stops the light only in part."""
LEAST_AREA_M2 = 0.03
REACH_M = 0.3
"""Of what was never seen, only this much beyond what was is told: farther off there may be nothing."""
MOST = 12

Grid = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Region:
    """Where to scan again: center_m (x, y), the middle of its widest place, where a circle of radius_m fits; area_m2;
    why: unseen, thin or unsure; found: what was measured there, in words."""

    center_m: tuple[float, float]
    radius_m: float
    area_m2: float
    why: str
    found: str


@dataclass(frozen=True, eq=False)
class RescanMaps:
    """What a plan's cells [rows, columns] say: unseen, floor unseen, free; the measures, nan where no surface is."""

    unseen: Mask
    bare: Mask
    free: Mask
    color_sigma: Grid
    depth_sigma_m: Grid
    alpha: Grid


def regions_of(doubts: RescanMaps, cell_m: float, origin_m: Matrix) -> list[Region]:
    """Return at most `MOST` regions of at least `LEAST_AREA_M2`, the largest first."""
    found = []
    for why, mask, say in _kinds(doubts, cell_m):
        labels, count = ndimage.label(_open(mask), np.ones((3, 3)))
        for number in range(1, count + 1):
            at = labels == number
            area_m2 = float(at.sum()) * cell_m**2
            if area_m2 >= LEAST_AREA_M2:
                (row, column), radius = _widest(at)
                center = (float(origin_m[0] + (column + 0.5) * cell_m), float(origin_m[1] + (row + 0.5) * cell_m))
                found.append(Region(center, radius * cell_m, area_m2, why, say(at)))
    return sorted(found, key=lambda region: -region.area_m2)[:MOST]


def _kinds(d: RescanMaps, cell_m: float) -> list[tuple[str, Mask, Callable[[Mask], str]]]:
    """Return each reason's cells and the words for some of them."""
    typical = float(np.nanmedian(d.color_sigma)) if np.isfinite(d.color_sigma).any() else 1.0
    with np.errstate(invalid="ignore"):
        thin = np.asarray(d.alpha < THIN_ALPHA)
        blurred, patchy = d.depth_sigma_m > UNSURE_DEPTH_M, d.color_sigma > UNSURE_COLOR * typical

    def doubt(at: Mask) -> str:
        depth = f"depth ± {100.0 * np.nanmean(d.depth_sigma_m[at]):.1f} cm"
        color = f"colour {np.nanmean(d.color_sigma[at]) / typical:.1f} times as unsure as usual"
        return ", ".join(words for words, cause in ((depth, blurred), (color, patchy)) if cause[at].any())

    return [
        ("unseen", _hidden(d.unseen, d.free | d.bare, cell_m), lambda at: "never in view"),
        ("unseen", d.bare, lambda at: "seen through, but its floor was never in view"),
        ("thin", thin, lambda at: f"lets {100.0 * (1.0 - np.nanmean(d.alpha[at])):.0f} % of the light through"),
        ("unsure", np.asarray((blurred | patchy) & ~thin), doubt),
    ]


def _open(mask: Mask) -> Mask:
    """Close gaps of a cell, then drop what is only one cell wide."""
    closed = ndimage.binary_closing(np.pad(mask, 1), np.ones((3, 3), bool))[1:-1, 1:-1]
    return np.asarray(ndimage.binary_opening(closed, np.ones((2, 2), bool)))


def _widest(mask: Mask) -> tuple[tuple[float, float], float]:
    """Return row and column of the middle of the widest place, and how many cells it is wide on either side.

    Of places as wide, those within half a cell, their mean if it is one of them, else the one nearest to it.
    """
    inside = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    places = np.argwhere(inside >= inside.max() - 0.5)
    middle = places.mean(0)
    nearest = places[((places - middle) ** 2).sum(1).argmin()]
    row, column = middle if np.abs(nearest - middle).max() <= 0.5 else nearest
    return (float(row), float(column)), float(inside.max()) - 0.5


def _hidden(unseen: Mask, empty: Mask, cell_m: float) -> Mask:
    """Return the unseen cells within the hull of what was seen and within reach of seen empty space.

    Reach goes through unseen cells only: what lies behind a wall was not missed.
    """
    inside = unseen & _hull(~unseen)
    frontier = inside & ndimage.binary_dilation(empty)
    if not frontier.any():
        return frontier
    return np.asarray(ndimage.binary_dilation(frontier, iterations=max(1, round(REACH_M / cell_m)), mask=inside))


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
