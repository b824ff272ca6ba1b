"""Make a floor plan of a map: cells seen from above with what is there, its uncertainty, and what is not observed."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Camera, Matrix, Progress, Trajectory
from sigmasplat.plugins.evaluation.view_scores import Renderer
from sigmasplat.plugins.outputs.floorplan import ground

CELL_M = 0.05
UNOBSERVED, FLOOR_UNOBSERVED, FREE, OBJECT, WALL = range(5)
"""Kinds of cells. FLOOR_UNOBSERVED: a ray passed above the cell, but its floor was not observed."""
SIGNS = "?,.o#"
"""One sign per kind, for the rows of `FloorPlan.record`."""
MEANINGS = ("not observed", "floor not observed", "free floor", "object", "wall or tall object")
LOW_M, HIGH_M = 0.1, 2.0
"""Heights of obstacles. Everything higher is left out, such as lamps and the ceiling."""
LAYER_M = 0.1
WALL_LAYERS = 8
"""A cell with surfaces in this many layers of height is a wall."""
MIN_POINTS = 2
"""A single point in a layer is ignored as noise."""
MARGIN_CELLS = 4
MOST_CELLS = 4_000_000
"""Cells of the largest plan: 100 m × 100 m with cells of 5 cm, which take 0.7 GB."""
LONGEST_RAY = 10
"""How far a ray is followed, in diagonals of the plan."""

Grid = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A map from above, cells [rows, columns] of size cell_m; row 0 is at the lowest y, column 0 at the lowest x.

    T_floor_world: z up, floor at 0, x and y along the walls; origin_m: x, y of the outer corner of row 0, column 0.
    kind: UNOBSERVED, FLOOR_UNOBSERVED, FREE, OBJECT or WALL. alpha: mean opacity of the surfaces in the cell;
    depth_sigma_m: their mean predicted standard deviation of depth; wrong_share: the share of their pixels whose colour
    is expected to be wrong (`WRONG_BY`). They are nan in cells without a surface, and the last two also without
    predicted errors. path_m [N, 2]: the camera path.
    """

    cell_m: float
    origin_m: Matrix
    T_floor_world: Matrix
    kind: NDArray[np.uint8]
    alpha: Grid
    depth_sigma_m: Grid
    wrong_share: Grid
    path_m: Matrix

    @property
    def predicted_errors(self) -> bool:
        """Return whether the errors of the map are predicted."""
        return bool(np.isfinite(self.wrong_share).any())

    def area_m2(self, *kinds: int) -> float:
        """Return the total area of the cells of these kinds."""
        return float(np.isin(self.kind, kinds).sum()) * self.cell_m**2

    def record(self) -> dict[str, Any]:
        """Return the plan as values for JSON: the frame, and one sign per cell (row 0 at the lowest y)."""
        return {
            "resolution_m": self.cell_m,
            "origin_m": self.origin_m,
            "axes": "x right, y up on the plan, z up from the floor; row 0 at the lowest y, column 0 at the lowest x",
            "T_floor_world": self.T_floor_world,
            "free_m2": self.area_m2(FREE),
            "predicted_errors": self.predicted_errors,
            "legend": dict(zip(SIGNS, MEANINGS, strict=True)),
            "cells": ["".join(SIGNS[kind] for kind in row) for row in self.kind],
        }


def floor_plan(
    field: api.GaussianField, trajectory: Trajectory, camera: Camera, *, cell_m: float = CELL_M,
    renderer: Renderer = api.render, predictor: ground.SurfacePredictor | None = None, up: ground.Up | None = None,
    progress: Progress = api.no_progress,
) -> FloorPlan:  # fmt: skip
    """Make the floor plan of a map from poses along its path; `camera` gives the field of view.

    predictor: predicts the errors of the map, if they are known (`uncertainty.predictive.predict`). up: as in
    `floor_frame`. Calls `progress(poses done, total)`. Raises ConfigError unless 1 mm ≤ cell_m ≤ 1 m; SigmaSplatError
    if no surface is visible, or the plan has more than `MOST_CELLS`.
    """
    if not 0.001 <= cell_m <= 1.0:
        raise api.ConfigError(f"a cell of the floor plan must be 0.001 to 1 m wide, found {cell_m}")
    samples = list(ground.sample_surfaces(field, trajectory, camera, renderer, progress=progress, predictor=predictor))
    T_floor_world = ground.floor_frame(samples, up)

    def to_floor(points: NDArray[np.floating]) -> Matrix:
        return np.asarray(points.astype(np.float64) @ T_floor_world[:3, :3].T + T_floor_world[:3, 3])

    path = to_floor(trajectory.T_world_camera[:, :3, 3])
    grid = _Cells.around([to_floor(sample.points) for sample in samples], path, cell_m)
    for sample in samples:
        grid.add_rays(to_floor(sample.points), to_floor(sample.T_world_camera[None, :3, 3])[0])
    for sample in samples:
        grid.add_points(to_floor(sample.points), sample)
    alpha, depth_m, wrong = grid.means()
    return FloorPlan(cell_m, grid.origin_m, T_floor_world, grid.kinds(), alpha, depth_m, wrong, path[:, :2])


def run_floor_plan(
    run: api.RunFolder, path: Trajectory, camera: Camera, *, cell_m: float = CELL_M, up: ground.Edge = "auto",
    progress: Progress = api.no_progress,
) -> FloorPlan:  # fmt: skip
    """Make the floor plan of a run's map.

    path: the believed poses; camera: that of the images the run worked on; up: at this edge of the images.
    It is rendered with the run's settings, and
    its errors are predicted if the run has measured how sure its map is. Calls `progress(poses done, total)`. Raises
    RunError without a map, or if the uncertainty belongs to another map; ConfigError unless 1 mm ≤ cell_m ≤ 1 m;
    SigmaSplatError if no surface is visible.
    """
    config, field = run.config(), run.read_map()
    known, predictor = run.uncertainty_of(field), None
    if known is not None:
        predictor = partial(api.predict, field, known, options=config.render, backend=config.backend)
    return floor_plan(
        field, path, camera, cell_m=cell_m, renderer=api.FieldRenderer(config.render, config.backend),
        predictor=predictor, up=ground.up_of(path.T_world_camera, run.facts(), up), progress=progress,
    )  # fmt: skip


class _Cells:
    """Counts and sums per cell, to which surface samples are added. All points are in the frame of the floor."""

    def __init__(self, origin_m: Matrix, shape: tuple[int, int], cell_m: float) -> None:
        self.origin_m, self.shape, self.cell_m = origin_m, shape, cell_m
        size = shape[0] * shape[1]
        self.layers = round((HIGH_M - LOW_M) / LAYER_M)
        self.points, self.passed = np.zeros((size, self.layers)), np.zeros(size)
        self.weight, self.sums = np.zeros(size), np.zeros((3, size))

    @staticmethod
    def around(points: Sequence[Matrix], path: Matrix, cell_m: float) -> "_Cells":
        """Make a grid that holds the path and the points, except 0.2 % outliers at each end of each axis."""
        flat = np.concatenate([p[:, :2] for p in points])
        low = np.minimum(np.quantile(flat, 0.002, axis=0), path[:, :2].min(0))
        high = np.maximum(np.quantile(flat, 0.998, axis=0), path[:, :2].max(0))
        first = np.floor(low / cell_m) - MARGIN_CELLS
        count = np.ceil(high / cell_m) + MARGIN_CELLS - first
        if not np.prod(count) <= MOST_CELLS:  # also if it is NaN
            size = " × ".join(f"{n * cell_m:.0f}" for n in count)
            raise api.SigmaSplatError(
                f"a floor plan of {size} m has too many cells of {cell_m} m (at most {MOST_CELLS:,}); use larger cells"
            )
        return _Cells(first * cell_m, (int(count[1]), int(count[0])), cell_m)

    def cell_index(self, points: Matrix) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the flat index of the cell of each point, and which points are inside the grid."""
        cells = np.floor((points[:, :2] - self.origin_m) / self.cell_m).astype(np.intp)
        inside = ((cells >= 0) & (cells < [self.shape[1], self.shape[0]])).all(1)
        return np.asarray(cells[:, 1] * self.shape[1] + cells[:, 0], np.intp), np.asarray(inside)

    def add_rays(self, points: Matrix, eye: Matrix) -> None:
        """Mark the cells between the camera and every third point as passed, up to two cells before the point."""
        rays = points[::3] - eye
        length = np.linalg.norm(rays, axis=1)
        farthest = min(length.max(initial=0.0), LONGEST_RAY * float(np.hypot(*self.shape)) * self.cell_m)
        steps = np.arange(0.0, max(farthest - 2 * self.cell_m, 0.0), self.cell_m)
        for step in steps:
            far = length > step + 2 * self.cell_m
            at = eye + rays[far] * (step / length[far])[:, None]
            cell, inside = self.cell_index(at)
            inside &= (at[:, 2] > LOW_M) & (at[:, 2] < HIGH_M)
            self.passed[np.unique(cell[inside])] += 1

    def add_points(self, points: Matrix, sample: ground.SurfaceSample) -> None:
        """Add surface points: their number per layer of height, and their measurements."""
        cell, inside = self.cell_index(points)
        standing = inside & (points[:, 2] > LOW_M) & (points[:, 2] < HIGH_M)
        layer = np.minimum(((points[standing, 2] - LOW_M) / LAYER_M).astype(int), self.layers - 1)
        np.add.at(self.points, (cell[standing], layer), 1)
        used = inside & (points[:, 2] > -LOW_M) & (points[:, 2] < HIGH_M)
        area = sample.area_m2[used].astype(np.float64)
        self.weight += np.bincount(cell[used], area, len(self.weight))
        measured = sample.alpha, sample.depth_sigma_m, sample.wrong_share
        for total, values in zip(self.sums, measured, strict=True):
            total += np.bincount(cell[used], area * values[used], len(total))

    def kinds(self) -> NDArray[np.uint8]:
        """Return the kind of each cell [rows, columns]."""
        filled = (self.points >= MIN_POINTS).sum(1)
        kind = np.where(self.passed > 0, FLOOR_UNOBSERVED, UNOBSERVED)
        kind = np.where(self.weight > 0, FREE, kind)
        kind = np.where(filled >= WALL_LAYERS, WALL, np.where(filled > 0, OBJECT, kind))
        return kind.astype(np.uint8).reshape(self.shape)

    def means(self) -> Grid:
        """Return means weighted by area, [3, rows, columns]: alpha, depth sigma, wrong share; nan without a surface."""
        means = np.divide(self.sums, self.weight, out=np.full_like(self.sums, np.nan), where=self.weight > 0)
        return np.asarray(means.reshape(3, *self.shape), np.float32)
