"""Find the floor in what a map shows: which way is up, how high the floor lies, which way the walls run."""

from collections.abc import Sequence

import numpy as np

from sigmasplat.errors import SigmaSplatError
from sigmasplat.floorplan.surface_samples import SurfaceSample
from sigmasplat.types import Matrix

TILT = np.cos(np.deg2rad(40.0))
"""Cameras are held upright, give or take this."""
ALIKE = np.cos(np.deg2rad(8.0))
CANDIDATES = 400
LEAST_SHARE = 0.02
"""Of all area: a floor, ceiling or table tops of less do not say which way is up."""
LAYER_M = 0.025
FLOOR_SHARE = 0.1
"""The floor is the lowest layer with at least this share of the largest one's area: a table may show more."""
SEEN_MOST = 16_000
"""Points are thinned to so many."""


def floor_frame(sights: Sequence[SurfaceSample]) -> Matrix:
    """Return T_floor_world: z up, floor at z = 0, origin below the first camera, x and y along the walls.

    y is the direction along the walls nearest to where the first camera looks. Everything but that follows the world
    where it is moved. Raises SigmaSplatError if nothing is seen.
    """
    points, normals, area = _thinned(sights)
    poses = np.stack([sight.T_world_camera for sight in sights])
    up = upwards(normals, area, poses)
    height_m = floor_height(points @ up, normals @ up, area, float((poses[:, :3, 3] @ up).min()))
    ahead = _horizontal(poses[0], up)
    ahead = along_walls(normals, area, up, ahead)
    R = np.stack([np.cross(ahead, up), ahead, up])
    foot = poses[0, :3, 3] - (poses[0, :3, 3] @ up - height_m) * up
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ foot
    return T


def _thinned(sights: Sequence[SurfaceSample]) -> tuple[Matrix, Matrix, Matrix]:
    """Return points, normals [P, 3] and areas [P] of all sights, every k-th."""
    total = sum(len(sight.points) for sight in sights)
    if not total:
        raise SigmaSplatError("the map shows no surface from its path; is it a map of splats, and its path?")
    step = max(1, total // SEEN_MOST)
    stacked = [np.concatenate([getattr(s, name) for s in sights])[::step] for name in ("points", "normals", "area_m2")]
    points, normals, area = (values.astype(np.float64) for values in stacked)
    return points, normals, area


def upwards(normals: Matrix, area: Matrix, poses: Matrix) -> Matrix:
    """Return the unit vector upwards: of the normals within 40° of the cameras' mean up the one that most area agrees
    with, lying along it or at right angles to it.

    Where hardly any area lies level, at right angles to the walls; without walls, the cameras' mean up.
    """
    held = _unit(-poses[:, :3, 1].sum(0), -poses[0, :3, 1])
    level = np.abs(normals @ held) > TILT
    if area[level].sum() < LEAST_SHARE * area.sum():
        return _across_walls(normals, area, held)
    rows = np.flatnonzero(level)
    candidates = normals[rows[np.linspace(0, len(rows) - 1, min(CANDIDATES, len(rows))).astype(int)]]
    cosines = np.abs(candidates @ normals.T)
    votes = ((cosines > ALIKE) + 0.5 * (cosines < np.sqrt(1.0 - ALIKE**2))) @ area
    up = candidates[int(votes.argmax())]
    for _ in range(3):
        cosine = normals @ up
        agree = np.abs(cosine) > ALIKE
        up = _unit((np.sign(cosine) * area)[agree] @ normals[agree], up)
    return np.asarray(up * np.sign(up @ held))


def _across_walls(normals: Matrix, area: Matrix, held: Matrix) -> Matrix:
    """Return the direction that upright surfaces have least to do with, if there are two walls, else `held`."""
    walls = np.abs(normals @ held) < np.sqrt(1.0 - TILT**2)
    values, vectors = np.linalg.eigh((normals[walls] * area[walls, None]).T @ normals[walls])
    if not walls.any() or values[0] > 0.2 * values[1]:
        return held
    up = vectors[:, 0] * np.sign(vectors[:, 0] @ held)
    return up if up @ held > TILT else held


def floor_height(heights_m: Matrix, cosines: Matrix, area: Matrix, camera_m: float) -> float:
    """Return the floor's height: of the layers that face up, below all cameras, the lowest with much area.

    heights_m [P] and cosines to up [P] of points on surfaces. Without any, nearly the lowest point there is.
    """
    level = (cosines > ALIKE) & (heights_m < camera_m)
    if area[level].sum() < 0.1 * LEAST_SHARE * area.sum():
        return float(np.quantile(heights_m, 0.01))
    edges = np.arange(heights_m[level].min() - 2 * LAYER_M, camera_m + 3 * LAYER_M, LAYER_M)
    layers, _ = np.histogram(heights_m[level], edges, weights=area[level])
    pairs = layers[:-1] + layers[1:]  # a layer cut in two by an edge counts whole
    lowest = int(np.argmax(pairs >= FLOOR_SHARE * pairs.max()))
    peak = lowest + int(np.argmax(pairs[lowest : lowest + 3]))
    near = level & (np.abs(heights_m - edges[peak + 1]) < 1.5 * LAYER_M)
    order = np.argsort(heights_m[near])
    half = np.searchsorted(np.cumsum(area[near][order]), 0.5 * area[near].sum())
    return float(heights_m[near][order][half])


def along_walls(normals: Matrix, area: Matrix, up: Matrix, ahead: Matrix) -> Matrix:
    """Turn a level direction by at most 45° so that it runs along most walls; as it is where there are none."""
    walls = np.abs(normals @ up) < np.sqrt(1.0 - ALIKE**2)
    if area[walls].sum() < LEAST_SHARE * area.sum():
        return ahead
    aside = np.cross(ahead, up)
    angle = np.arctan2(normals[walls] @ aside, normals[walls] @ ahead)
    # Fourfold: walls at right angles vote for one angle. The strongest degree first, then the mean around it.
    votes = np.bincount(np.rint(np.rad2deg(angle)).astype(int) % 90, area[walls], 90)
    best = np.deg2rad(float(np.argmax(np.convolve(np.r_[votes[-2:], votes, votes[:2]], np.ones(5), "valid"))))
    off = np.angle(np.exp(4j * (angle - best))) / 4.0
    near = np.abs(off) < np.deg2rad(8.0)
    turn = best + (off[near] @ area[walls][near]) / area[walls][near].sum()
    turn = (turn + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return np.asarray(np.cos(turn) * ahead + np.sin(turn) * aside)


def _horizontal(T_world_camera: Matrix, up: Matrix) -> Matrix:
    """Return the level direction a camera looks in; where it looks straight down, that of its image's upper edge."""
    for direction in (T_world_camera[:3, 2], -T_world_camera[:3, 1]):
        level = direction - (direction @ up) * up
        if np.linalg.norm(level) > 0.3:
            break
    return _unit(level, level)


def _unit(vector: Matrix, otherwise: Matrix) -> Matrix:
    """Return a vector at length 1, another one where it has none."""
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length) if length > 1e-9 else otherwise
