"""Extract the surface of a truncated signed distance field: marching cubes, brick by brick, without seams."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from sigmasplat.data.mesh import Mesh
from sigmasplat.data.tsdf import BLOCK, BLUE, COLOR_WEIGHT, DISTANCE, GREEN, RED, WEIGHT, Tsdf, packed, unpacked

BRICK = 8
"""Blocks along the edge of a brick, which is the volume that one call of marching cubes processes."""
EDGE = BRICK * BLOCK + 1
"""Voxels along the edge of a brick; its last layer is the first layer of the next brick."""
LEAST_DISTANCE = 1e-3
"""Distances closer to 0 than this (in units of the truncation) are moved away from 0. Then no vertex is exactly on a
voxel, and each vertex is on its own edge of the lattice."""

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


def surface(volume: Tsdf) -> Mesh:
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
    """A brick's surface: vertices [V, 3] m, the lattice edge of each vertex [V] as a key, colors [V, 3], faces [F,
    3]."""

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
