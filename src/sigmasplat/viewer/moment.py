"""Hold what is shown of a run at one moment: path, keyframes, map. Data alone: no browser, no file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field as dataclass_field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.metrics.palette import Rgb
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS, GaussianField, Rows
from sigmasplat.types import Matrix

BUDGET = 300_000
"""Splats that a browser is given at most: 10 MB, and what it sorts at each move of the camera."""
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""Shape of the frusta where a run does not say what its camera was."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the map: splats in a frame of their own, and T_world_piece, where that lies. Splats that change come
    as another field; the same object stays as it was. submap: its number, None for the map as a whole."""

    submap: int | None
    field: GaussianField
    T_world_piece: Matrix = dataclass_field(default_factory=lambda: np.eye(4))

    @property
    def name(self) -> str:
        """Return what the piece is called in the scene."""
        return "map" if self.submap is None else f"submap-{self.submap}"


@dataclass(frozen=True, eq=False)
class Path:
    """Poses of all frames so far: T_world_camera [F, 4, 4], which were lost bool [F], their submaps [F], and the rows
    of the frames that are keyframes, growing."""

    T_world_camera: Matrix
    lost: NDArray[np.bool_]
    submaps: NDArray[np.int64]
    keyframes: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.T_world_camera)


NO_PATH = Path(np.empty((0, 4, 4)), np.empty(0, np.bool_), np.empty(0, np.int64), ())


@dataclass(frozen=True, eq=False)
class Moment:
    """A run at one moment. final: the map in one piece once it is made; pieces: the submaps side by side; together with
    final they may be absent. true_positions [M, 3] m, in the run's world, where an evaluation has stored them.
    picture: gives what the keyframe at a row of the path saw, None where nobody kept it."""

    title: str
    path: Path = NO_PATH
    final: Piece | None = None
    pieces: tuple[Piece, ...] = ()
    true_positions: Matrix | None = None
    camera: Camera = CAMERA
    picture: Callable[[int], Rgb | None] = lambda row: None
    options: RenderConfig = dataclass_field(default_factory=RenderConfig)
    backend: str = "auto"
    live: bool = False
    status: str = ""

    def shown(self, whole: bool, row: int) -> tuple[Piece, ...]:
        """Return the pieces to show: the final map, if it is asked for and there, else the submaps begun by frame
        `row` of the path."""
        if self.final is not None and (whole or not self.pieces):
            return (self.final,)
        if not len(self.path):
            return self.pieces
        until = int(self.path.submaps[np.clip(row, 0, len(self.path) - 1)])
        return tuple(piece for piece in self.pieces if piece.submap is None or piece.submap <= until)


def to_look_at(params: Tensor, attributes: Mapping[str, Tensor]) -> GaussianField:
    """Return parameter rows [N, 17] with attributes as a field that is not fitted: its moments are one shared zero,
    which saves two thirds of the memory."""
    moments = [values.new_zeros(()).expand_as(values) for values in (params, *attributes.values())]
    rows = {n: Rows(values, zero, zero) for (n, values), zero in zip(attributes.items(), moments[1:], strict=True)}
    return GaussianField(params, moments[0], moments[0], attributes=rows)


def bare(splats: GaussianField) -> GaussianField:
    """Return the splats without what only a fit needs; parameters are shared, not copied."""
    return to_look_at(splats.params, {name: rows.params for name, rows in splats.attributes.items()})


def thinned(splats: GaussianField, most: int) -> GaussianField:
    """Return at most so many splats in memory of their own, the host's, evenly spread over the rows, each as much wider
    as keeps the area covered."""
    n = len(splats)
    rows = torch.arange(n) if n <= most else (torch.arange(max(most, 0)) * n).div(most, rounding_mode="floor")
    rows = rows.to(splats.params.device)
    few = to_look_at(
        splats.params[rows].cpu(), {name: attribute.params[rows].cpu() for name, attribute in splats.attributes.items()}
    )
    if len(few):
        few.params[:, COLUMNS["log_scales"]] += 0.5 * float(np.log(n / len(few)))
    return few


def within_budget(pieces: Sequence[Piece], budget: int) -> tuple[Piece, ...]:
    """Return the pieces with at most `budget` splats together: as they are where they fit, else each thinned by the
    same share, to three quarters of the budget, so that the next ones do not thin them all again."""
    total = sum(len(piece.field) for piece in pieces)
    if total <= budget:
        return tuple(pieces)
    share = 0.75 * budget / total
    return tuple(replace(piece, field=thinned(piece.field, int(share * len(piece.field)))) for piece in pieces)
