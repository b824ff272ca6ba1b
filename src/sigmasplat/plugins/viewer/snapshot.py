"""Store the state of a run that the viewer shows at one time: path, keyframes, map; choose what is drawn of a path.

It needs no browser and no file.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field as dataclass_field, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import COLUMNS, Camera, GaussianField, MapUncertainty, Matrix, RenderConfig, Rows, evenly_spaced
from sigmasplat.plugins.outputs.drawing.colormap import Rgb
from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, DARK, GREEN

BUDGET = 300_000
"""Maximum number of splats sent to a browser: 10 MB, which it sorts after each camera move."""
DEFAULT_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""Gives the frusta their shape if the run's camera is not known."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the map: splats in their own frame, and the pose T_world_piece of that frame.

    submap: its number, or None for the final map. If splats change, the piece gets a new field object; an unchanged
    object means unchanged splats. uncertainty: how sure the splats are, None if it was not measured; sure: which are
    shown by default, bool [N], None for all.
    """

    submap: int | None
    field: GaussianField
    T_world_piece: Matrix = dataclass_field(default_factory=lambda: np.eye(4))
    uncertainty: MapUncertainty | None = None
    sure: Tensor | None = None

    @property
    def name(self) -> str:
        """Return the piece's name in the scene."""
        return "map" if self.submap is None else f"submap-{self.submap}"

    @property
    def depth_std_m(self) -> Tensor | None:
        """Return the predicted standard deviation of the depth that each splat shows [N], m; None if not measured."""
        std = None if self.uncertainty is None else self.uncertainty.std
        return None if std is None else std.depth_std_m

    def thinned(self, most: int) -> "Piece":
        """Return a copy with at most `most` splats (`thin`)."""
        rows = thinned_rows(len(self.field), most)
        known = None if self.uncertainty is None else self.uncertainty.at(rows)
        sure = None if self.sure is None else self.sure[rows]
        return replace(self, field=thin(self.field, most), uncertainty=known, sure=sure)


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The frames so far: poses T_world_camera [F, 4, 4], whether each is lost bool [F], its submap [F], and the rows of
    the keyframes in ascending order.

    outside: whether each frame is not connected to the world (`outside_world`) [F]; such frames are not drawn, because
    their poses are in the frame of another component. None: all are connected.
    """

    T_world_camera: Matrix
    lost: NDArray[np.bool_]
    submaps: NDArray[np.int64]
    keyframes: tuple[int, ...]
    outside: NDArray[np.bool_] | None = None

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Return whether each frame is connected to the world [F]."""
        return np.ones(len(self), np.bool_) if self.outside is None else ~self.outside

    def __len__(self) -> int:
        return len(self.T_world_camera)


class Opening(NamedTuple):
    """What a browser sees first: its camera's pose [4, 4], the distance m of the point that it looks at, the camera
    whose image it shows, and the unit vector [3] that points up."""

    T_world_camera: Matrix
    ahead_m: float
    camera: Camera
    up: Matrix

    def fov(self, aspect: float) -> float:
        """Return the vertical field of view, rad, of a window with this ratio of width to height. A wide window shows
        the whole width of the image and nothing beside it; a tall one is between the whole image and a full window."""
        wider = aspect * self.camera.height / self.camera.width
        return 2.0 * float(np.arctan(0.5 * self.camera.height / self.camera.fy / max(wider, wider**0.5)))


EMPTY_PATH = CameraPath(np.empty((0, 4, 4)), np.empty(0, np.bool_), np.empty(0, np.int64), ())


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The state of a run at one time.

    final: the final map, None before it is made; pieces: the submaps until then.
    true_positions [M, 3] m in the run's world, None unless an evaluation has stored them. image(row) returns the image
    of the keyframe at a row of the path, or None if it was not kept. opening: None unless the run has finished.
    """

    title: str
    path: CameraPath = EMPTY_PATH
    final: Piece | None = None
    pieces: tuple[Piece, ...] = ()
    true_positions: Matrix | None = None
    camera: Camera = DEFAULT_CAMERA
    image: Callable[[int], Rgb | None] = lambda row: None
    options: RenderConfig = dataclass_field(default_factory=RenderConfig)
    backend: str = "auto"
    live: bool = False
    status: str = ""
    opening: Opening | None = None

    def visible_pieces(self, row: int) -> tuple[Piece, ...]:
        """Return the final map if it exists, else the submaps started up to frame `row`."""
        if self.final is not None:
            return (self.final,)
        if not len(self.path):
            return self.pieces
        last = int(self.path.submaps[np.clip(row, 0, len(self.path) - 1)])
        return tuple(piece for piece in self.pieces if piece.submap is None or piece.submap <= last)


def field_without_moments(params: Tensor, attributes: Mapping[str, Tensor]) -> GaussianField:
    """Return a field of parameter rows [N, 17] and attributes that is not optimised.

    Adam's moments are views of a single zero, which saves two thirds of the memory.
    """
    moments = [values.new_zeros(()).expand_as(values) for values in (params, *attributes.values())]
    rows = {n: Rows(values, zero, zero) for (n, values), zero in zip(attributes.items(), moments[1:], strict=True)}
    return GaussianField(params, moments[0], moments[0], attributes=rows)


def thinned_rows(n: int, most: int) -> Tensor:
    """Return the rows of at most `most` of `n` splats, spread evenly."""
    return torch.arange(n) if n <= most else (torch.arange(max(most, 0)) * n).div(most, rounding_mode="floor")


def thin(splats: GaussianField, most: int) -> GaussianField:
    """Return a copy on the host of at most `most` splats, spread evenly over the rows.

    The remaining splats are enlarged, so that the covered area stays the same.
    """
    n = len(splats)
    rows = thinned_rows(n, most).to(splats.params.device)
    kept = field_without_moments(
        splats.params[rows].cpu(), {name: extra.params[rows].cpu() for name, extra in splats.attributes.items()}
    )
    if len(kept):
        kept.params[:, COLUMNS["log_scales"]] += 0.5 * float(np.log(n / len(kept)))
    return kept


def within_budget(pieces: Sequence[Piece], budget: int) -> tuple[Piece, ...]:
    """Return the pieces with at most `budget` splats in total.

    Pieces that fit are returned unchanged. Otherwise each one is thinned by the same factor, to three quarters of the
    budget in total, so that the next pieces do not cause another thinning immediately.
    """
    total = sum(len(piece.field) for piece in pieces)
    if total <= budget:
        return tuple(pieces)
    share = 0.75 * budget / total
    return tuple(piece.thinned(int(share * len(piece.field))) for piece in pieces)


Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MAX_SEGMENTS = 5000
MAX_KEYFRAMES = 100
SUBMAP_COLOURS = (DARK[ACCENT], DARK[GREEN])
"""Used alternately, so that neighbouring submaps differ."""
TRUTH_COLOUR = DARK[BLUE]
LOST_COLOUR = (255, 60, 60)


class Segments(NamedTuple):
    """Line segments: points [S, 2, 3] m in the world, colors uint8 [S, 2, 3]."""

    points: Floats
    colors: Bytes


def path_segments(path: CameraPath, row: int, most: int = MAX_SEGMENTS) -> Segments:
    """Return the path up to frame `row`, in alternating colours per submap, red at lost frames.

    A long path is reduced to about `most` evenly spaced segments. Frames outside the world are left out.
    """
    rows = evenly_spaced(min(row + 1, len(path)), most + 1)
    colors = np.array(SUBMAP_COLOURS, np.uint8)[path.submaps[rows] % len(SUBMAP_COLOURS)]
    colors[path.lost[rows]] = LOST_COLOUR
    segments, inside = _segments(path.T_world_camera[rows, :3, 3], colors), path.inside[rows]
    drawn = inside[:-1] & inside[1:]
    return Segments(segments.points[drawn], segments.colors[drawn])


def truth_segments(positions: Matrix, most: int = MAX_SEGMENTS) -> Segments:
    """Return segments of the true path [M, 3] m in the world, at most about `most`."""
    rows = evenly_spaced(len(positions), most + 1)
    return _segments(positions[rows], np.tile(np.array(TRUTH_COLOUR, np.uint8), (len(rows), 1)))


def keyframes_to_show(path: CameraPath, row: int, most: int = MAX_KEYFRAMES) -> tuple[int, ...]:
    """Return the rows of at most `most` keyframes up to frame `row`: every 2ᵏ-th one and the last.

    With a power of two most of the keyframes shown stay the same while new ones are added.
    """
    inside = path.inside
    rows = [keyframe for keyframe in path.keyframes if keyframe <= row and inside[keyframe]]
    stride = 1
    while len(rows) / stride > most - 1:
        stride *= 2
    return tuple(sorted({*rows[::stride], *rows[-1:]}))


def _segments(positions: Matrix, colors: Bytes) -> Segments:
    """Return the segments between neighbouring positions [n, 3]; a segment has the colours of its ends."""
    pairs = [np.stack([values[:-1], values[1:]], 1) for values in (positions, colors)]
    return Segments(np.asarray(pairs[0], np.float32), np.asarray(pairs[1], np.uint8))
