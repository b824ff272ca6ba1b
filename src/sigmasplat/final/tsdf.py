"""Fuse depth images into a truncated signed distance field on sparse blocks of voxels (VarSplat §7).

A voxel contains the weighted mean of D − z over the images that see it. z is its depth; D is the depth of the surface
in its pixel. The value is positive in front of the surface and negative behind it. D is taken at the exact point where
the voxel projects, not at the centre of the pixel. The inverse depth of a plane is affine in (u, v), so its slope in
the image gives D at that point exactly. The surface is extracted by marching cubes, brick by brick, without seams.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh
from sigmasplat.errors import ConfigError
from sigmasplat.types import Matrix

Floats = NDArray[np.float32]
Image = NDArray[np.floating]
Keys = NDArray[np.int64]

BLOCK = 8
"""Voxels along a block's edge."""
BLOCKS_PER_PAGE = 1024
BLOCKS_AT_ONCE = 128
"""Number of blocks whose voxels fit in the processor's cache."""
NEAR_M = 0.02
DISTANCE, WEIGHT, RED, GREEN, BLUE, COLOR_WEIGHT = range(6)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
LOCAL = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""Voxels of a block in the order they are stored, [512, 3]."""


class Tsdf:
    """Blocks of 8³ voxels, allocated near surfaces; voxel (i, j, k) is at (i, j, k) · voxel_m in the world.

    Memory: 24 bytes per voxel: distance in units of the truncation, weight, colour, weight of the colour.
    """

    def __init__(self, voxel_m: float = 0.01, truncation_m: float = 0.04) -> None:
        """Make an empty field. Raises ConfigError unless 0 < 2 · voxel_m ≤ truncation_m."""
        if not (0.0 < 2.0 * voxel_m <= truncation_m < np.inf):
            raise ConfigError(
                f"a voxel must be above 0 and at most half the truncation, found {voxel_m} m and {truncation_m} m"
            )
        self.voxel_m, self.truncation_m = voxel_m, truncation_m
        self._keys, self._numbers = np.empty(0, np.int64), np.empty(0, np.intp)
        self._pages: list[Floats] = []

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self._keys)

    @property
    def blocks(self) -> Keys:
        """Return the blocks' coordinates [B, 3] in units of a block, ordered by x, y, z."""
        return unpacked(self._keys)

    def find(self, blocks: Keys) -> NDArray[np.intp]:
        """Return the number [N] of each block from its coordinates [N, 3], −1 if it was never allocated."""
        if not len(self._keys):
            return np.full(len(blocks), -1, np.intp)
        wanted = packed(blocks)
        place = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        return np.where(self._keys[place] == wanted, self._numbers[place], -1)

    def voxels(self, numbers: NDArray[np.intp], plane: int) -> Floats:
        """Return one plane of the blocks with these numbers: [N, 512]."""
        out = np.empty((len(numbers), BLOCK**3), np.float32)
        pages, rows = np.divmod(numbers, BLOCKS_PER_PAGE)
        for page in np.unique(pages):
            at = pages == page
            out[at] = self._pages[page][rows[at], plane]
        return out

    def at(self, numbers: NDArray[np.intp], local: NDArray[np.intp]) -> Floats:
        """Return all planes of single voxels [N, 6], given by block number and index in the block."""
        out = np.empty((len(numbers), 6), np.float32)
        pages, rows = np.divmod(numbers, BLOCKS_PER_PAGE)
        for page in np.unique(pages):
            at = np.flatnonzero(pages == page)
            out[at] = self._pages[page][rows[at], :, local[at]]
        return out

    def integrate(
        self, depth_m: Image, color: Image, camera: Camera, T_world_camera: Matrix, weight: Image | None = None
    ) -> None:
        """Add an image: depth [H, W] m, 0 = no reading; color [H, W, 3]; weight [H, W] ≥ 0 per pixel (default 1).

        All blocks in view are updated, so that observed free space removes surfaces that only other images saw.
        """
        image = _Image.of(depth_m, color, camera, weight)
        self.allocate(image.rays, image.depth_m, T_world_camera)
        numbers, corners = self._in_view(image, T_world_camera)
        steps = _projected(LOCAL * self.voxel_m, camera, se3.inverse(T_world_camera)[:3, :3])
        for page in np.unique(numbers // BLOCKS_PER_PAGE):
            of_page = np.flatnonzero(numbers // BLOCKS_PER_PAGE == page)
            for at in np.array_split(of_page, -(-len(of_page) // BLOCKS_AT_ONCE)):
                a, b, z = (corners[k, at, None] + steps[k] for k in range(3))
                self._update(self._pages[page], numbers[at] % BLOCKS_PER_PAGE, image, a, b, z)

    def allocate(self, rays: Floats, depth_m: Floats, T_world_camera: Matrix) -> None:
        """Allocate the blocks near a surface: within the truncation along z, or one voxel in any direction.

        rays [P, 3]: those of pixels in the camera's frame, z = 1; depth_m [P]: their depth, above 0.
        """
        R, t = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3].astype(np.float32)
        rays = rays @ R.T
        surface = rays * depth_m[:, None] + t
        shifted = [surface + rays * np.float32(share * self.truncation_m) for share in (-1.0, -0.5, 0.5, 1.0)]
        shifted += [surface + ((2 * corner - 1) * self.voxel_m).astype(np.float32) for corner in CORNERS]
        per_metre = np.float32(1.0 / (BLOCK * self.voxel_m))
        found = np.unique(np.concatenate([_runs(packed(np.floor(p * per_metre).astype(np.int64))) for p in shifted]))
        new = found[~np.isin(found, self._keys)]
        numbers = np.arange(len(self), len(self) + len(new))
        keys = np.concatenate([self._keys, new])
        order = np.argsort(keys)
        self._keys, self._numbers = keys[order], np.concatenate([self._numbers, numbers])[order]
        while len(self._pages) * BLOCKS_PER_PAGE < len(self):
            self._pages.append(np.zeros((BLOCKS_PER_PAGE, 6, BLOCK**3), np.float32))

    def _in_view(self, image: "_Image", T_world_camera: Matrix) -> tuple[NDArray[np.intp], Floats]:
        """Return numbers [N] and projected first corners [3, N] of the blocks that may be visible, sorted by number."""
        T, edge_m = se3.inverse(T_world_camera), BLOCK * self.voxel_m
        corners = self.blocks * edge_m @ T[:3, :3].T + T[:3, 3]
        seen = image.may_see(corners + T[:3, :3].sum(1) * edge_m / 2, np.sqrt(0.75) * edge_m, self.truncation_m)
        order = np.argsort(self._numbers[seen])
        a, b, z = _projected(corners[seen][order], image.camera)
        return self._numbers[seen][order], np.stack([a, b, z])

    def _update(self, page: Floats, rows: NDArray[np.intp], image: "_Image", a: Floats, b: Floats, z: Floats) -> None:
        """Average the image into the rows [N] of a page; voxels are at pixel (a/z, b/z) and depth z, [N, 512] each."""
        distance, weight, pixel = image.distances(a, b, z)
        weight *= distance > -self.truncation_m
        touched = np.flatnonzero(weight.any(1))
        if not len(touched):
            return
        distance, weight, pixel = distance[touched], weight[touched], pixel[touched]
        voxels = page[rows[touched]]
        capped = np.minimum(distance / np.float32(self.truncation_m), np.float32(1.0))
        _average(voxels, (DISTANCE,), WEIGHT, [capped], weight)
        weight *= distance < self.truncation_m  # empty space has no colour
        _average(voxels, (RED, GREEN, BLUE), COLOR_WEIGHT, [plane[pixel] for plane in image.color], weight)
        page[rows[touched]] = voxels


def _average(voxels: Floats, planes: tuple[int, ...], total: int, values: list[Floats], weight: Floats) -> None:
    """Update weighted means with new values of given weight; plane `total` contains the weight so far."""
    voxels[:, total] += weight
    gain = weight / np.maximum(voxels[:, total], np.float32(1e-12))
    for plane, value in zip(planes, values, strict=True):
        voxels[:, plane] += (value - voxels[:, plane]) * gain


@dataclass(frozen=True, eq=False)
class _Image:
    """A prepared image: depth_m [P] and rays [P, 3] of the pixels with weight, and flat planes [(H+2)·(W+2)]: inverse
    depth w, its slopes per pixel, weight, red, green, blue. The border of one pixel has weight 0."""

    camera: Camera
    depth_m: Floats
    rays: Floats
    inverse: Floats
    slope_u: Floats
    slope_v: Floats
    weight: Floats
    color: list[Floats]

    @staticmethod
    def of(depth_m: Image, color: Image, camera: Camera, weight: Image | None) -> "_Image":
        """Prepare an image; a pixel counts if it has depth and weight."""
        depth_m = depth_m.astype(np.float32)
        weight = (depth_m > 0) * (np.float32(1.0) if weight is None else weight)
        use = weight > 0
        w = np.divide(np.float32(1.0), depth_m, out=np.zeros(depth_m.shape, np.float32), where=use)
        planes = (w, _slope(w, 1), _slope(w, 0), weight, *np.moveaxis(color, 2, 0))
        w, u, v, weight, *rgb = (np.pad(plane.astype(np.float32), 1).ravel() for plane in planes)
        return _Image(camera, depth_m[use], camera.rays()[use], w, u, v, weight, rgb)

    def distances(self, a: Floats, b: Floats, z: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Return D − z, weight and flat pixel index of voxels that project to (a/z, b/z) at depth z."""
        per_z = np.float32(1.0) / np.maximum(z, np.float32(NEAR_M))
        u, v = a * per_z, b * per_z
        column, row = np.clip(np.rint(u), -1, self.camera.width), np.clip(np.rint(v), -1, self.camera.height)
        column[z < NEAR_M] = -1
        pixel = ((row + 1) * (self.camera.width + 2) + column + 1).astype(np.intp)
        w = self.inverse[pixel] + self.slope_u[pixel] * (u - column) + self.slope_v[pixel] * (v - row)
        return np.float32(1.0) / np.maximum(w, np.float32(1e-6)) - z, self.weight[pixel], pixel

    def may_see(self, centers: Matrix, radius_m: float, reach_m: float) -> NDArray[np.bool_]:
        """Return which spheres (centers [N, 3], camera frame) may be in view and not behind all surfaces."""
        c, z = self.camera, centers[:, 2]
        least = self.inverse - 0.5 * (np.abs(self.slope_u) + np.abs(self.slope_v))
        farthest_m = 1.0 / least[self.weight > 0].min(initial=np.inf)
        seen = (z > -radius_m) & (z < farthest_m + reach_m + radius_m)
        for axis, focal, first, last in ((0, c.fx, -c.cx, c.width - 1 - c.cx), (1, c.fy, -c.cy, c.height - 1 - c.cy)):
            for side, edge in ((1.0, (first - 0.5) / focal), (-1.0, (last + 0.5) / focal)):
                seen &= side * (centers[:, axis] - edge * z) > -radius_m * np.hypot(1.0, edge)
        return np.asarray(seen)


def _slope(w: Floats, axis: int) -> Floats:
    """Return the smaller of the differences to both neighbours along an axis, 0 if their signs differ (minmod).

    At an edge, the last pixel of a surface thus gets no slope from the other surface, and w stays positive in it.
    """
    w = np.moveaxis(w, axis, 0)
    step = np.where((w[1:] > 0) & (w[:-1] > 0), w[1:] - w[:-1], np.float32(0.0))
    zero = np.zeros_like(w[:1])
    ahead, behind = np.concatenate([step, zero]), np.concatenate([zero, step])
    smaller = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    return np.moveaxis(np.where(ahead * behind > 0, smaller, np.float32(0.0)), 0, axis)


def _projected(points: NDArray[np.floating], camera: Camera, R: Matrix | None = None) -> Floats:
    """Return (fx x + cx z, fy y + cy z, z) [3, N] of points [N, 3], rotated by R first."""
    x, y, z = (points if R is None else points @ R.T).T
    return np.stack([camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z, z]).astype(np.float32)


def packed(blocks: Keys) -> Keys:
    """Return block coordinates [N, 3], each within ±2²⁰, as one number [N] that keeps their order."""
    x, y, z = (blocks + (1 << 20)).T
    return np.asarray((x << 42) | (y << 21) | z)


def unpacked(keys: Keys) -> Keys:
    """Return the coordinates [N, 3] of packed numbers."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], -1) - (1 << 20)


def _runs(keys: Keys) -> Keys:
    """Drop adjacent duplicates. Most neighbours share a block, so this makes the sorting much faster."""
    return keys[np.concatenate([[True], keys[1:] != keys[:-1]])] if len(keys) else keys


BRICK = 8
"""Blocks along the edge of a brick, which is the volume that one call of marching cubes processes."""
EDGE = BRICK * BLOCK + 1
"""Voxels along the edge of a brick; its last layer is the first layer of the next brick."""
LEAST_DISTANCE = 1e-3
"""Distances closer to 0 than this (in units of the truncation) are moved away from 0. Then no vertex is exactly on a
voxel, and each vertex is on its own edge of the lattice."""

Ints = NDArray[np.int64]


def extract_surface(volume: Tsdf) -> Mesh:
    """Return the zero level set as a connected mesh with colours.

    Only cubes with eight observed voxels produce faces. The same field gives the same bytes.
    """
    bricks = unpacked(np.unique(packed(volume.blocks // BRICK)))
    parts = [part for brick in bricks if (part := _brick(volume, brick * BRICK))]
    if not parts:
        return Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty((0, 3), np.float32))
    starts = np.cumsum([0, *(len(part.edges) for part in parts)])
    faces = np.concatenate([part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)])
    _, first, welded = np.unique(np.concatenate([part.edges for part in parts]), True, True)
    vertices = np.concatenate([part.vertices for part in parts])[first]
    colors = np.concatenate([part.colors for part in parts])[first]
    return Mesh(vertices, welded.astype(np.int32)[faces], colors)


@dataclass(frozen=True, eq=False)
class _Part:
    """A brick's surface: vertices [V, 3] m, the lattice edge of each [V] as a key, colors [V, 3], faces [F, 3]."""

    vertices: Floats
    edges: Ints
    colors: Floats
    faces: NDArray[np.int32]


def _brick(volume: Tsdf, first_block: Ints) -> _Part | None:
    """Return the surface in a brick, None if it has no surface."""
    side = BRICK + 1
    numbers = volume.find(first_block + np.indices((side, side, side)).reshape(3, -1).T)
    there = np.flatnonzero(numbers >= 0)
    distance = _dense(volume.voxels(numbers[there], DISTANCE), there, np.float32(1.0))
    seen = _dense(volume.voxels(numbers[there], WEIGHT), there, np.float32(0.0)) > 0
    distance = np.where(np.abs(distance) < LEAST_DISTANCE, np.copysign(np.float32(LEAST_DISTANCE), distance), distance)
    cubes = _of_corners(seen, np.logical_and) & _of_corners(distance < 0, np.logical_or)
    cubes &= ~_of_corners(distance < 0, np.logical_and)
    if not cubes.any():
        return None
    mask = np.zeros(distance.shape, bool)
    mask[1:, 1:, 1:] = cubes  # scikit-image indexes a cube by its last corner
    cut: Callable[..., Any] = marching_cubes
    points, faces, _, _ = cut(distance, 0.0, mask=mask, gradient_direction="descent")
    # A vertex is between two voxels: one of its coordinates has a fraction, or, inside a cube, three. Twice the integer
    # part, plus 1 if there is a fraction, identifies the edge (or the cube). It is the same on both sides of a seam.
    whole = np.rint(points)
    broken = np.abs(points - whole) > 0.1 * LEAST_DISTANCE
    low = np.where(broken, np.floor(points), whole).astype(np.int64)
    high = low + broken
    first_voxel = first_block * BLOCK
    share = np.where(broken, points - low, 0.0).sum(1) / np.maximum(broken.sum(1), 1)
    colors = _colors(volume, numbers, low, high, share.astype(np.float32))
    vertices = ((points.astype(np.float64) + first_voxel) * volume.voxel_m).astype(np.float32)
    return _Part(vertices, packed(2 * (low + first_voxel) + broken), colors, faces.astype(np.int32))


def _dense(blocks: Floats, places: NDArray[np.intp], empty: np.float32) -> Floats:
    """Copy blocks [N, 512] to their places in a cube of blocks; return its first EDGE³ voxels."""
    side = BRICK + 1
    cube = np.full((side, BLOCK, side, BLOCK, side, BLOCK), empty, np.float32)
    x, y, z = np.unravel_index(places, (side, side, side))
    cube[x, :, y, :, z, :] = blocks.reshape(-1, BLOCK, BLOCK, BLOCK)
    return np.ascontiguousarray(cube.reshape([side * BLOCK] * 3)[:EDGE, :EDGE, :EDGE])


def _of_corners(corner: NDArray[np.bool_], join: Callable[..., NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Combine the eight corners of each cube; the result is shorter by one along each axis."""
    for axis in range(3):
        corner = np.moveaxis(corner, axis, 0)
        corner = np.moveaxis(join(corner[1:], corner[:-1]), 0, axis)
    return corner


def _colors(volume: Tsdf, numbers: NDArray[np.intp], low: Ints, high: Ints, share: Floats) -> Floats:
    """Interpolate the colours of two voxels [V, 3] (`share` of the second); a voxel without colour is ignored."""
    total, mixed = np.full(len(low), 1e-12, np.float32), np.zeros((len(low), 3), np.float32)
    for voxel, part in ((low, 1.0 - share), (high, share)):
        block, local = np.divmod(voxel, BLOCK)
        number = numbers[np.ravel_multi_index(tuple(block.T), (BRICK + 1,) * 3)]
        values = volume.at(number, np.ravel_multi_index(tuple(local.T), (BLOCK,) * 3))
        part = part * (values[:, COLOR_WEIGHT] > 0)
        total += part
        mixed += part[:, None] * values[:, [RED, GREEN, BLUE]]
    return np.asarray(np.clip(mixed / total[:, None], 0.0, 1.0))
