"""Triangulate the room's shapes: the true surface, including hidden faces."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.sources.room.shapes import Shape

EDGE_M = 0.05
"""Longest face along a shape's axes; small faces are either visible or hidden."""
MIN_SIDES = 48
"""Faces around a ball or a drum; the error of a ball of 13 cm is then 0.3 mm."""

Doubles = NDArray[np.float64]


def triangulate(shapes: Sequence[Shape]) -> Mesh:
    """Return the surfaces of all shapes as one mesh in the room's frame; overlapping parts are kept."""
    return Mesh.concatenated([_placed(shape, *patch) for shape in shapes for patch in _PATCHES[shape.kind](shape)])


def _placed(shape: Shape, unit: Doubles, faces: NDArray[np.int32]) -> Mesh:
    """Scale, rotate and move points [N, 3] of the unit shape; drop faces without area, as at the poles of a ball."""
    points = shape.to_room_axes((unit * shape.half).T.astype(np.float32)).T + shape.center
    mesh = Mesh(points.astype(np.float32), faces)
    return mesh.with_faces(mesh.areas() > 1e-12)


def _cells(length_m: float) -> int:
    return max(1, int(np.ceil(length_m / EDGE_M)))


def _grid(columns: int, rows: int) -> tuple[Doubles, Doubles, NDArray[np.int32]]:
    """Return s, t [N] over the unit square and faces [F, 3], counter-clockwise with s to the right and t up."""
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    number = np.arange(s.size, dtype=np.int32).reshape(s.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return s.ravel(), t.ravel(), faces


def _box(shape: Shape) -> list[tuple[Doubles, NDArray[np.int32]]]:
    """Return the six sides of a box."""
    sides = []
    for axis in range(3):
        across, up = (axis + 1) % 3, (axis + 2) % 3
        s, t, faces = _grid(_cells(2 * shape.half[across]), _cells(2 * shape.half[up]))
        for side in (-1.0, 1.0):
            unit = np.empty((len(s), 3))
            unit[:, axis], unit[:, across], unit[:, up] = side, 2 * s - 1, 2 * t - 1
            sides.append((unit, faces if side > 0 else faces[:, ::-1]))
    return sides


def _ball(shape: Shape) -> list[tuple[Doubles, NDArray[np.int32]]]:
    """Return the surface of a ball."""
    around = max(MIN_SIDES, _cells(2 * np.pi * float(shape.half.max())))
    s, t, faces = _grid(around, around // 2)
    longitude, latitude = 2 * np.pi * s, np.pi * (t - 0.5)
    level = np.cos(latitude)
    return [(np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], -1), faces)]


def _drum(shape: Shape) -> list[tuple[Doubles, NDArray[np.int32]]]:
    """Return the side and the caps of a drum."""
    radius = float(shape.half[:2].max())
    around = max(MIN_SIDES, _cells(2 * np.pi * radius))
    s, t, faces = _grid(around, _cells(2 * shape.half[2]))
    side = np.stack([np.cos(2 * np.pi * s), np.sin(2 * np.pi * s), 2 * t - 1], -1)
    s, t, rings = _grid(around, _cells(radius))
    cap = np.stack([t * np.cos(2 * np.pi * s), t * np.sin(2 * np.pi * s), np.ones_like(s)], -1)
    return [(side, faces), (cap * [1, 1, -1], rings), (cap, rings[:, ::-1])]


_PATCHES = {"box": _box, "ball": _ball, "drum": _drum}
