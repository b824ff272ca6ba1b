"""Intersect many rays with boxes, balls and drums (ellipsoids and elliptic cylinders).

Every shape is a unit shape scaled by `half`, rotated by `yaw_rad` about the vertical and moved to `center`. A ray is
transformed to the unit shape; its parameter t stays the same. The room's frame: metres, z up, floor at z = 0.
Rays are stored as [3, N] so that each coordinate is contiguous.
Triangles of all shapes are the true surface, including hidden faces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Camera, Mesh
from sigmasplat.plugins.sources.room.textures import Floats, Material

Indices = NDArray[np.intp]
Kind = Literal["box", "ball", "drum"]

CUBE = list(product((-1, 1), repeat=3))
MIN_RAY_PARAMETER = 1e-3
"""Hits with a smaller ray parameter are on the surface where the ray starts."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid: kind, center [3] m, half extents [3] m, yaw (radians about z), material."""

    kind: Kind
    center: Floats
    half: Floats
    yaw_rad: float
    material: Material

    def to_room_axes(self, v: Floats, sign: int = 1) -> Floats:
        """Rotate vectors [3, ...] from the shape's axes to the room's; back with sign −1."""
        if self.yaw_rad == 0.0:
            return v
        c, s = np.float32(np.cos(sign * self.yaw_rad)), np.float32(np.sin(sign * self.yaw_rad))
        return np.stack([c * v[0] - s * v[1], s * v[0] + c * v[1], np.broadcast_to(v[2], v[0].shape)])

    def local(self, points: Floats) -> Floats:
        """Return room points [3, N] in the shape's frame, metres."""
        return self.to_room_axes(points - self.center[:, None], -1)

    def first_hit(self, origins: Floats, directions: Floats) -> Floats:
        """Return the ray parameter [N] where rays enter, inf for a miss; origins [3, 1] or [3, N]."""
        o = self.local(origins) / self.half[:, None]
        d = self.to_room_axes(directions, -1) / self.half[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            enter, leave = _INTERVALS[self.kind](o, d)
            hit = (enter < leave) & (enter > MIN_RAY_PARAMETER)
        return np.where(hit, enter, np.float32(np.inf)).astype(np.float32)

    def corners(self) -> NDArray[np.float64]:
        """Return the 8 corners of the bounding box, room frame [8, 3]."""
        return (self.to_room_axes((np.array(CUBE, np.float32) * self.half).T).T + self.center).astype(np.float64)


def dot(a: Floats, b: Floats) -> Floats:
    """Return the inner products [N] of vectors [2 or 3, N], by coordinate, which is faster than a sum over the axis."""
    total: Floats = a[0] * b[0] + a[1] * b[1]
    return total if len(a) == 2 else total + a[2] * b[2]


def normalised(v: Floats) -> Floats:
    """Return unit vectors [3, N]."""
    return (v / np.maximum(np.sqrt(dot(v, v)), 1e-9)).astype(np.float32)


def _slab(o: Floats, d: Floats) -> tuple[Floats, Floats]:
    """Return the interval of t with |o + t d| ≤ 1 for each coordinate."""
    per_unit = 1.0 / np.where(d == 0.0, np.float32(1e-9), d)
    middle, half = -o * per_unit, np.abs(per_unit)
    return middle - half, middle + half


def _within_unit(o: Floats, d: Floats) -> tuple[Floats, Floats]:
    """Return the interval of t with ‖o + t d‖ ≤ 1, about the closest point for accuracy."""
    a = np.maximum(dot(d, d), 1e-12)
    middle = -dot(o, d) / a
    nearest = o + middle * d
    half_chord = np.sqrt(np.maximum((1.0 - dot(nearest, nearest)) / a, 0.0))
    return middle - half_chord, middle + half_chord


def _box_interval(o: Floats, d: Floats) -> tuple[Floats, Floats]:
    enter, leave = _slab(o, d)
    return enter.max(0), leave.min(0)


def _drum_interval(o: Floats, d: Floats) -> tuple[Floats, Floats]:
    (near_side, far_side), (near_cap, far_cap) = _within_unit(o[:2], d[:2]), _slab(o[2], d[2])
    return np.maximum(near_side, near_cap), np.minimum(far_side, far_cap)


_INTERVALS = {"box": _box_interval, "ball": _within_unit, "drum": _drum_interval}


def surface_at(shape: Shape, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return outward normals [3, N] (room frame) and surface coordinates u, v [N] in metres at points on a shape.

    u, v run along the face of a box and the cap of a drum, around and up a ball or a drum's side.
    """
    p = shape.local(points)
    unit = p / shape.half[:, None]
    if shape.kind == "box":
        axis = np.abs(unit).argmax(0)
        normal = np.where(np.arange(3)[:, None] == axis, np.sign(unit), 0.0).astype(np.float32)
        return shape.to_room_axes(normal), np.where(axis == 0, p[1], p[0]), np.where(axis == 2, p[1], p[2])
    around = (np.arctan2(unit[1], unit[0]) * shape.half[0]).astype(np.float32)
    if shape.kind == "ball":
        return shape.to_room_axes(normalised(unit / shape.half[:, None])), around, p[2]
    cap = np.abs(unit[2]) > np.hypot(unit[0], unit[1])
    side = unit / shape.half[:, None] * np.array([[1.0], [1.0], [0.0]], np.float32)
    normal = np.where(cap, np.sign(unit[2]) * np.array([[0.0], [0.0], [1.0]]), normalised(side)).astype(np.float32)
    return shape.to_room_axes(normal), np.where(cap, p[0], around), np.where(cap, p[1], p[2])


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays from origins [3, 1] or [3, N] along directions [3, N]; pixels [2, N]: their image coordinates."""

    origins: Floats
    directions: Floats
    pixels: Floats | None = None


Windows = list[tuple[float, float, float, float] | None]


def cast_rays(shapes: Sequence[Shape], rays: Rays, windows: Windows | None = None) -> tuple[Floats, Indices]:
    """Return the nearest hit of each ray: its parameter [N] (inf: none) and the index of the shape [N] (−1: none).

    `windows`, from `image_windows`, limits each shape to the pixels where it can be visible.
    """
    n = rays.directions.shape[1]
    nearest, index = np.full(n, np.inf, np.float32), np.full(n, -1, np.intp)
    for k, shape in enumerate(shapes):
        if windows is None or rays.pixels is None:
            t = shape.first_hit(rays.origins, rays.directions)
            first = np.flatnonzero(t < nearest)
            nearest[first], index[first] = t[first], k
        elif (window := windows[k]) is not None:
            (u, v), (u0, v0, u1, v1) = rays.pixels, window
            among = np.flatnonzero((u >= u0) & (u <= u1) & (v >= v0) & (v <= v1))
            t = shape.first_hit(rays.origins, rays.directions if len(among) == n else rays.directions[:, among])
            closer = t < nearest[among]
            nearest[among[closer]], index[among[closer]] = t[closer], k
    return nearest, index


def image_windows(shapes: Sequence[Shape], T_camera_world: NDArray[np.float64], camera: Camera) -> Windows:
    """Return the bounding box of each shape in the image: (u0, v0, u1, v1) pixels, None if it is not visible."""
    return [_window(shape.corners() @ T_camera_world[:3, :3].T + T_camera_world[:3, 3], camera) for shape in shapes]


def _window(corners: NDArray[np.float64], camera: Camera) -> tuple[float, float, float, float] | None:
    z = corners[:, 2]
    if z.max() < 0.01:
        return None
    if z.min() < 0.01:  # partly behind the camera: the projected corners do not bound it
        return -1.0, -1.0, camera.width, camera.height
    u, v = camera.fx * corners[:, 0] / z + camera.cx, camera.fy * corners[:, 1] / z + camera.cy
    if u.max() < -1 or v.max() < -1 or u.min() > camera.width or v.min() > camera.height:
        return None
    return float(u.min()), float(v.min()), float(u.max()), float(v.max())


EDGE_M, MIN_SIDES = 0.05, 48
"""Longest face along a shape's axes, as small faces are either visible or hidden; faces around a ball or a drum: the
error of a ball of 13 cm is then 0.3 mm."""

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
    around = max(MIN_SIDES, _cells(2 * np.pi * float(shape.half.max())))
    s, t, faces = _grid(around, around // 2)
    longitude, latitude = 2 * np.pi * s, np.pi * (t - 0.5)
    level = np.cos(latitude)
    return [(np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], -1), faces)]


def _drum(shape: Shape) -> list[tuple[Doubles, NDArray[np.int32]]]:
    radius = float(shape.half[:2].max())
    around = max(MIN_SIDES, _cells(2 * np.pi * radius))
    s, t, faces = _grid(around, _cells(2 * shape.half[2]))
    side = np.stack([np.cos(2 * np.pi * s), np.sin(2 * np.pi * s), 2 * t - 1], -1)
    s, t, rings = _grid(around, _cells(radius))
    cap = np.stack([t * np.cos(2 * np.pi * s), t * np.sin(2 * np.pi * s), np.ones_like(s)], -1)
    return [(side, faces), (cap * [1, 1, -1], rings), (cap, rings[:, ::-1])]


_PATCHES = {"box": _box, "ball": _ball, "drum": _drum}
