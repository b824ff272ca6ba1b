"""Draw up a plan of what a map shows, cell by cell from above: what is there, how sure it is, what it never saw."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import ConfigError
from sigmasplat.floorplan import surface_samples
from sigmasplat.floorplan.ground import floor_frame
from sigmasplat.floorplan.rescan import Region, RescanMaps, regions_of
from sigmasplat.floorplan.surface_samples import SurfaceSample
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.render import render
from sigmasplat.types import Matrix, Progress

CELL_M = 0.05
UNSEEN, BARE, FREE, THING, WALL = range(5)
"""What a cell is: never seen; seen through, but not its floor; free floor; something stands there; something tall."""
SIGNS = "?,.o#"
"""Of the kinds, in the record's rows."""
MEANINGS = ("never seen", "floor never seen", "free", "something", "wall or something tall")
LOW_M, HIGH_M = 0.1, 2.0
"""What people bump into is in between; what hangs higher is left out, as is the ceiling."""
LAYER_M = 0.1
WALL_LAYERS = 8
LEAST_POINTS = 2
"""A single pixel is not believed."""
MARGIN_CELLS = 4

Grid = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A map from above, cells [rows, columns] of cell_m; row 0 is at the lowest y, column 0 at the lowest x.

    T_floor_world: z up, floor at 0, x and y along the walls; origin_m: x, y of the corner where row and column 0 begin.
    kind: UNSEEN, BARE, FREE, THING or WALL. color_sigma: mean √σ² of the splats there (colour, 0 to 1);
    depth_sigma_m: mean spread in depth of the surfaces there; alpha: how opaque they are; nan where there is no
    surface. path_m [N, 2]: where the camera went. regions: where to scan again, the largest first.
    """

    cell_m: float
    origin_m: Matrix
    T_floor_world: Matrix
    kind: NDArray[np.uint8]
    color_sigma: Grid
    depth_sigma_m: Grid
    alpha: Grid
    path_m: Matrix
    regions: tuple[Region, ...]

    def area_m2(self, *kinds: int) -> float:
        """Return the area of the cells of some kinds."""
        return float(np.isin(self.kind, kinds).sum()) * self.cell_m**2

    def record(self) -> dict[str, Any]:
        """Return what JSON holds of the plan: the frame, a sign per cell (rows from the lowest y up), the regions."""
        T_world_floor = se3.inverse(self.T_floor_world)
        places = [
            np.append(region.center_m, 0.0) @ T_world_floor[:3, :3].T + T_world_floor[:3, 3] for region in self.regions
        ]
        return {
            "resolution_m": self.cell_m,
            "origin_m": self.origin_m,
            "axes": "x right, y up on the plan, z up from the floor; row 0 at the lowest y, column 0 at the lowest x",
            "T_floor_world": self.T_floor_world,
            "free_m2": self.area_m2(FREE),
            "legend": dict(zip(SIGNS, MEANINGS, strict=True)),
            "cells": ["".join(SIGNS[kind] for kind in row) for row in self.kind],
            "scan_again": [
                asdict(region) | {"center_world_m": place} for region, place in zip(self.regions, places, strict=True)
            ],
        }


def floor_plan(
    field: GaussianField,
    trajectory: Trajectory,
    camera: Camera,
    *,
    cell_m: float = CELL_M,
    most: int = surface_samples.MOST,
    renderer: surface_samples.Renderer = render,
    progress: Progress = lambda done, total: None,
) -> FloorPlan:
    """Look at a map from its path and draw up its plan; `camera` gives the field of view, `most` poses are looked from.

    `progress` is told (looks done, of how many). Raises ConfigError unless 1 mm ≤ cell_m ≤ 1 m; SigmaSplatError if
    nothing is seen.
    """
    if not 0.001 <= cell_m <= 1.0:
        raise ConfigError(f"a cell of the floor plan must be 0.001 to 1 m wide, found {cell_m}")
    seen = list(surface_samples.looks(field, trajectory, camera, renderer, most, progress))
    T_floor_world = floor_frame(seen)
    moved = partial(_moved, T_floor_world)
    grid = _Cells.around([moved(sight.points) for sight in seen], moved(trajectory.T_world_camera[:, :3, 3]), cell_m)
    for sight in seen:
        grid.carve(moved(sight.points), moved(sight.T_world_camera[None, :3, 3])[0])
    for sight in seen:
        grid.fill(moved(sight.points), sight)
    kind, (alpha, depth_sigma_m) = grid.kinds(), grid.means()
    color_sigma = grid.of_splats(moved(field.means.numpy()), field)
    color_sigma[np.isnan(alpha)] = np.nan
    path_m = moved(trajectory.T_world_camera[:, :3, 3])[:, :2]
    doubts = RescanMaps(kind == UNSEEN, kind == BARE, kind == FREE, color_sigma, depth_sigma_m, alpha)
    regions = regions_of(doubts, cell_m, grid.origin_m)
    return FloorPlan(
        cell_m, grid.origin_m, T_floor_world, kind, color_sigma, depth_sigma_m, alpha, path_m, tuple(regions)
    )  # fmt: skip


def _moved(T: Matrix, points: NDArray[np.floating]) -> Matrix:
    return np.asarray(points.astype(np.float64) @ T[:3, :3].T + T[:3, 3])


class _Cells:
    """Counts and sums per cell while sights are added: points in the floor's frame throughout."""

    def __init__(self, origin_m: Matrix, shape: tuple[int, int], cell_m: float) -> None:
        self.origin_m, self.shape, self.cell_m = origin_m, shape, cell_m
        size = shape[0] * shape[1]
        self.layers = round((HIGH_M - LOW_M) / LAYER_M)
        self.points, self.passed = np.zeros((size, self.layers)), np.zeros(size)
        self.weight, self.sums = np.zeros(size), np.zeros((2, size))

    @staticmethod
    def around(points: Sequence[Matrix], path: Matrix, cell_m: float) -> "_Cells":
        """Make cells for all points but a hundredth at each end, and the path; edges at whole cells."""
        flat = np.concatenate([p[:, :2] for p in points])
        low = np.minimum(np.quantile(flat, 0.002, axis=0), path[:, :2].min(0))
        high = np.maximum(np.quantile(flat, 0.998, axis=0), path[:, :2].max(0))
        first = np.floor(low / cell_m).astype(int) - MARGIN_CELLS
        count = np.ceil(high / cell_m).astype(int) + MARGIN_CELLS - first
        return _Cells(first * cell_m, (int(count[1]), int(count[0])), cell_m)

    def place(self, points: Matrix) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the cell of each point as one number, and which points have one."""
        cells = np.floor((points[:, :2] - self.origin_m) / self.cell_m).astype(np.intp)
        inside = ((cells >= 0) & (cells < [self.shape[1], self.shape[0]])).all(1)
        return np.asarray(cells[:, 1] * self.shape[1] + cells[:, 0], np.intp), np.asarray(inside)

    def carve(self, points: Matrix, eye: Matrix) -> None:
        """Note the cells that the light passes on its way to every third point, up to two cells before it."""
        rays = points[::3] - eye
        length = np.linalg.norm(rays, axis=1)
        steps = np.arange(0.0, max(length.max(initial=0.0) - 2 * self.cell_m, 0.0), self.cell_m)
        for step in steps:
            far = length > step + 2 * self.cell_m
            at = eye + rays[far] * (step / length[far])[:, None]
            cell, inside = self.place(at)
            inside &= (at[:, 2] > LOW_M) & (at[:, 2] < HIGH_M)
            self.passed[np.unique(cell[inside])] += 1

    def fill(self, points: Matrix, sight: SurfaceSample) -> None:
        """Add points on surfaces: how many in each layer of height, and what the map says of them."""
        cell, inside = self.place(points)
        standing = inside & (points[:, 2] > LOW_M) & (points[:, 2] < HIGH_M)
        layer = np.minimum(((points[standing, 2] - LOW_M) / LAYER_M).astype(int), self.layers - 1)
        np.add.at(self.points, (cell[standing], layer), 1)
        judged = inside & (points[:, 2] > -LOW_M) & (points[:, 2] < HIGH_M)
        for total, values in ((self.weight, None), (self.sums[0], sight.alpha), (self.sums[1], sight.depth_sigma_m)):
            area = sight.area_m2[judged].astype(np.float64)
            total += np.bincount(cell[judged], area if values is None else area * values[judged], len(total))

    def kinds(self) -> NDArray[np.uint8]:
        """Return what each cell is."""
        filled = (self.points >= LEAST_POINTS).sum(1)
        kind = np.where(self.passed > 0, BARE, UNSEEN)
        kind = np.where(self.weight > 0, FREE, kind)
        kind = np.where(filled >= WALL_LAYERS, WALL, np.where(filled > 0, THING, kind))
        return kind.astype(np.uint8).reshape(self.shape)

    def means(self) -> Grid:
        """Return mean alpha and depth sigma by area [2, rows, columns], nan where no surface was seen."""
        means = np.divide(self.sums, self.weight, out=np.full_like(self.sums, np.nan), where=self.weight > 0)
        return np.asarray(means.reshape(2, *self.shape), np.float32)

    def of_splats(self, centers: Matrix, field: GaussianField) -> Grid:
        """Return mean colour σ of the splats in each cell, by opacity and size; nan without any."""
        cell, inside = self.place(centers)
        inside &= (centers[:, 2] > -LOW_M) & (centers[:, 2] < HIGH_M)
        scales = np.sort(field.scales.numpy()[inside], axis=1).astype(np.float64)
        weight = field.opacities.numpy()[inside] * scales[:, 1] * scales[:, 2]
        sigma = np.sqrt(field.variances.numpy()[inside].mean(1)).astype(np.float64)
        size = self.shape[0] * self.shape[1]
        total = np.bincount(cell[inside], weight, size)
        sums = np.bincount(cell[inside], weight * sigma, size)
        means = np.divide(sums, total, out=np.full(size, np.nan), where=total > 0)
        return np.asarray(means.reshape(self.shape), np.float32)
