"""Sample the surfaces of a map from poses along its path, and find the floor: its height, up, and the walls."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfc

import sigmasplat.api as api
from sigmasplat.api import Camera, GaussianField, Matrix, se3
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, Renderer, as_array

WIDTH_PX = 160
"""Width of the rendered images: at 5 m a pixel is about 4 cm wide."""
MAX_POSES = 60
WRONG_BY = 0.1
"""A pixel counts as wrong if its colour, 0 to 1, is off by more than this."""
MAX_DEPTH_STEP = 0.05
"""A pixel is dropped as an edge if the depth of a neighbour differs by more than this share."""

Floats = NDArray[np.float32]

SurfacePredictor = Callable[[Camera, Matrix], api.Predicted]
"""Predicts the errors of a field from T_camera_world."""


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Surfaces seen from one pose, one sample per pixel [P]; edges and pixels without a surface are left out.

    points, normals [P, 3] m in the world, normals towards the camera; area_m2: area of the surface in the pixel; alpha;
    depth_sigma_m: the predicted standard deviation of depth; wrong_share: the predicted probability that the colour is
    off by more than `WRONG_BY`. Both are nan without a prediction.
    """

    T_world_camera: Matrix
    points: Floats
    normals: Floats
    area_m2: Floats
    alpha: Floats
    depth_sigma_m: Floats
    wrong_share: Floats


def sample_surfaces(
    field: GaussianField, trajectory: api.Trajectory, camera: Camera, renderer: Renderer, max_poses: int = MAX_POSES,
    progress: api.Progress = api.no_progress, predictor: SurfacePredictor | None = None,
) -> Iterator[SurfaceSample]:  # fmt: skip
    """Sample from at most `max_poses` poses, evenly spaced over the path, including the first and the last."""
    small = camera.resized(WIDTH_PX, max(1, round(camera.height * WIDTH_PX / camera.width)))
    rows = api.evenly_spaced(len(trajectory), max_poses)
    for done, row in enumerate(rows, 1):
        yield sample_surface(field, small, trajectory.T_world_camera[row], renderer, predictor)
        progress(done, len(rows))


def sample_surface(
    field: GaussianField, camera: Camera, T_world_camera: Matrix, renderer: Renderer,
    predictor: SurfacePredictor | None = None,
) -> SurfaceSample:  # fmt: skip
    """Sample from one pose: render depth, and predict its error if a predictor is given."""
    T_camera_world = se3.inverse(T_world_camera)
    with torch.inference_mode():
        seen = renderer(field, camera, T_camera_world)
        alpha, depth_m = as_array(seen.alpha), as_array((seen.depth / seen.alpha.clamp(min=COVERED_ALPHA)).float())
        sigma_m, wrong = (np.full_like(depth_m, np.nan) for _ in range(2))
        if predictor is not None:
            predicted = predictor(camera, T_camera_world)
            sigma_m = as_array(predicted.depth_std_m)
            # The probability that a Gaussian error of colour is larger than `WRONG_BY`.
            wrong[:] = erfc(WRONG_BY / np.sqrt(2.0 * np.maximum(as_array(predicted.color), 1e-12)))
    inner = np.s_[1:-1, 1:-1]
    on = _smooth(depth_m, alpha > COVERED_ALPHA)
    points = camera.rays() * depth_m[..., None]
    across = np.cross(points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2])[on]
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    normals = across / length[:, None]
    on_surface = points[inner][on]
    normals *= -np.sign((normals * on_surface).sum(1, keepdims=True))
    R, t = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3].astype(np.float32)
    planes = (values[inner][on] for values in (alpha, sigma_m, wrong))
    measured = (on_surface @ R.T + t, normals @ R.T, length / 4.0, *planes)
    return SurfaceSample(T_world_camera, *(np.asarray(values, np.float32) for values in measured))


def _smooth(depth_m: Floats, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which inner pixels [H − 2, W − 2] lie on one surface with their four neighbours."""
    z, on = depth_m[1:-1, 1:-1], covered[1:-1, 1:-1].copy()
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        near = np.s_[rows : rows + z.shape[0], columns : columns + z.shape[1]]
        on &= covered[near] & (np.abs(depth_m[near] - z) < MAX_DEPTH_STEP * z)
    return on


Edge = Literal["auto", "top", "left", "right", "bottom"]
EDGES = {"top": (1, -1.0), "left": (0, -1.0), "right": (0, 1.0), "bottom": (1, 1.0)}
"""The axis of the camera, and its sign, that point to each edge of an image."""
MAX_TILT_COS = np.cos(np.deg2rad(40.0))
"""Cameras are assumed upright within 40°."""
MEASURED_COS = np.cos(np.deg2rad(6.0))
"""A direction from an accelerometer is right within 6°, also if the camera gained 1 m/s in one second."""
PARALLEL_COS = np.cos(np.deg2rad(8.0))
CANDIDATES = 400
MIN_LEVEL_SHARE = 0.02
"""If level surfaces have less than this share of all area, they are not used to find the up direction."""
LAYER_M = 0.025
MIN_FLOOR_SHARE = 0.1
"""The floor is the lowest layer with at least this share of the largest layer's area: a table may have more area."""
MAX_POINTS = 16_000
"""Samples are reduced to about this many points."""


class Up(NamedTuple):
    """About where up is: a unit vector [3] of the world, and the cosine of the largest angle to it; how it is known."""

    up: Matrix
    within_cos: float
    how: str


def up_of(T_world_camera: Matrix, facts: Mapping[str, Any] | None = None, edge: Edge = "auto") -> Up:
    """Return about where up is for a path [N, 4, 4]: at an edge of the images, as the user says; else as an
    accelerometer measured it (facts: run.json of the run); else at the top, as cameras are mostly held."""
    measured = api.noted_up(facts or {})
    if edge == "auto" and measured is not None:
        return Up(measured, MEASURED_COS, "measured by the accelerometer")
    axis, sign = EDGES["top" if edge == "auto" else edge]
    towards = sign * T_world_camera[:, :3, axis]
    how = "the top of the images, if the camera was held upright: --up left, right or bottom turn it"
    first = towards[0] if len(towards) else sign * np.eye(3)[axis]
    return Up(unit(towards.sum(0), first), MAX_TILT_COS, how if edge == "auto" else f"the {edge} of the images")


def level_share(samples: Sequence[SurfaceSample], up: Matrix) -> float:
    """Return the share of the visible area that is level, if up [3] is up."""
    _, normals, area = _subsampled(samples)
    return float(area[np.abs(normals @ up) > PARALLEL_COS].sum() / area.sum())


def floor_frame(samples: Sequence[SurfaceSample], about: Up | None = None) -> Matrix:
    """Return T_floor_world: z up, floor at z = 0, origin below the first camera, x and y along the walls.

    about: where up is; None: as the cameras of the samples are held. The floor and the walls make it exact. y is the
    direction along the walls that is nearest to the viewing direction of the first camera. Raises SigmaSplatError if no
    surface is visible.
    """
    points, normals, area = _subsampled(samples)
    poses = np.stack([sample.T_world_camera for sample in samples])
    about = about or up_of(poses)
    up = up_direction(normals, area, about.up, about.within_cos)
    height_m = floor_height(points @ up, normals @ up, area, float((poses[:, :3, 3] @ up).min()))
    ahead = horizontal(poses[0], up)
    ahead = along_walls(normals, area, up, ahead)
    R = np.stack([np.cross(ahead, up), ahead, up])
    foot = poses[0, :3, 3] - (poses[0, :3, 3] @ up - height_m) * up
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ foot
    return T


def _subsampled(samples: Sequence[SurfaceSample]) -> tuple[Matrix, Matrix, Matrix]:
    """Return points, normals [P, 3] and areas [P] of every k-th sample."""
    total = sum(len(sample.points) for sample in samples)
    if not total:
        raise api.SigmaSplatError("no surface of the map is visible from its path; do map and path belong together?")
    step = max(1, total // MAX_POINTS)
    stacked = [np.concatenate([getattr(s, name) for s in samples])[::step] for name in ("points", "normals", "area_m2")]
    points, normals, area = (values.astype(np.float64) for values in stacked)
    return points, normals, area


def up_direction(normals: Matrix, area: Matrix, about_up: Matrix, within_cos: float = MAX_TILT_COS) -> Matrix:
    """Return the unit vector that points up, near `about_up` [3].

    Candidates are normals whose angle to `about_up` has at least the cosine `within_cos`. The best one has the most
    area whose normals are parallel (weight 1) or perpendicular (weight ½) to it. With too few level surfaces the result
    is perpendicular to the walls. Without walls it is `about_up`.
    """
    level = np.abs(normals @ about_up) > within_cos
    if area[level].sum() < MIN_LEVEL_SHARE * area.sum():
        return _across_walls(normals, area, about_up, within_cos)
    rows = np.flatnonzero(level)
    candidates = normals[rows[np.linspace(0, len(rows) - 1, min(CANDIDATES, len(rows))).astype(int)]]
    cosines = np.abs(candidates @ normals.T)
    votes = ((cosines > PARALLEL_COS) + 0.5 * (cosines < np.sqrt(1.0 - PARALLEL_COS**2))) @ area
    up = candidates[int(votes.argmax())]
    for _ in range(3):
        cosine = normals @ up
        agree = np.abs(cosine) > PARALLEL_COS
        up = unit((np.sign(cosine) * area)[agree] @ normals[agree], up)
    return np.asarray(up * np.sign(up @ about_up))


def _across_walls(normals: Matrix, area: Matrix, about_up: Matrix, within_cos: float) -> Matrix:
    """Return the direction perpendicular to the walls if there are walls in two directions, else `about_up`."""
    walls = np.abs(normals @ about_up) < np.sqrt(1.0 - within_cos**2)
    values, vectors = np.linalg.eigh((normals[walls] * area[walls, None]).T @ normals[walls])
    if not walls.any() or values[0] > 0.2 * values[1]:
        return about_up
    up = vectors[:, 0] * np.sign(vectors[:, 0] @ about_up)
    return up if up @ about_up > within_cos else about_up


def floor_height(heights_m: Matrix, cosines: Matrix, area: Matrix, camera_m: float) -> float:
    """Return the height of the floor: the lowest layer with much area that faces up and is below all cameras.

    heights_m [P] and cosines to up [P] of surface points. Without such a layer, the 1st percentile of the heights.
    """
    level = (cosines > PARALLEL_COS) & (heights_m < camera_m)
    if area[level].sum() < 0.1 * MIN_LEVEL_SHARE * area.sum():
        return float(np.quantile(heights_m, 0.01))
    edges = np.arange(heights_m[level].min() - 2 * LAYER_M, camera_m + 3 * LAYER_M, LAYER_M)
    layers, _ = np.histogram(heights_m[level], edges, weights=area[level])
    pairs = layers[:-1] + layers[1:]  # a layer split by a bin edge counts as one
    lowest = int(np.argmax(pairs >= MIN_FLOOR_SHARE * pairs.max()))
    peak = lowest + int(np.argmax(pairs[lowest : lowest + 3]))
    near = level & (np.abs(heights_m - edges[peak + 1]) < 1.5 * LAYER_M)
    order = np.argsort(heights_m[near])
    half = np.searchsorted(np.cumsum(area[near][order]), 0.5 * area[near].sum())
    return float(heights_m[near][order][half])


def along_walls(normals: Matrix, area: Matrix, up: Matrix, ahead: Matrix) -> Matrix:
    """Rotate a level direction by at most 45° so that it is parallel to most walls; unchanged without walls."""
    walls = np.abs(normals @ up) < np.sqrt(1.0 - PARALLEL_COS**2)
    if area[walls].sum() < MIN_LEVEL_SHARE * area.sum():
        return ahead
    aside = np.cross(ahead, up)
    angle = np.arctan2(normals[walls] @ aside, normals[walls] @ ahead)
    # Angles count modulo 90°, so that perpendicular walls vote for one angle: the best degree, then the mean around it.
    votes = np.bincount(np.rint(np.rad2deg(angle)).astype(int) % 90, area[walls], 90)
    best = np.deg2rad(float(np.argmax(np.convolve(np.r_[votes[-2:], votes, votes[:2]], np.ones(5), "valid"))))
    off = np.angle(np.exp(4j * (angle - best))) / 4.0
    near = np.abs(off) < np.deg2rad(8.0)
    turn = best + (off[near] @ area[walls][near]) / area[walls][near].sum()
    turn = (turn + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return np.asarray(np.cos(turn) * ahead + np.sin(turn) * aside)


def horizontal(T_world_camera: Matrix, up: Matrix) -> Matrix:
    """Return the horizontal viewing direction of a camera; looking straight down, that of the image's upper edge."""
    for direction in (T_world_camera[:3, 2], -T_world_camera[:3, 1]):
        level = direction - (direction @ up) * up
        if np.linalg.norm(level) > 0.3:
            break
    return unit(level, level)


def unit(vector: Matrix, otherwise: Matrix) -> Matrix:
    """Return a vector scaled to length 1, or `otherwise` if its length is 0."""
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length) if length > 1e-9 else otherwise
