"""Sample the surfaces of a map from poses along its path: points, normals and the standard deviation of depth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfc
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.evaluation.metrics.views import COVERED_ALPHA
from sigmasplat.render import Render
from sigmasplat.types import Matrix, Progress, no_progress
from sigmasplat.uncertainty.predictive import Predicted

WIDTH_PX = 160
"""Width of the rendered images: at 5 m a pixel is about 4 cm wide."""
MAX_POSES = 60
WRONG_BY = 0.1
"""A pixel counts as wrong if its colour, 0 to 1, is off by more than this."""
MAX_DEPTH_STEP = 0.05
"""A pixel is dropped as an edge if the depth of a neighbour differs by more than this share."""

Floats = NDArray[np.float32]


class SurfaceRenderer(Protocol):
    """Renders a field from T_camera_world; with a reference depth [H, W], m, also U about it (`render.render`)."""

    def __call__(
        self, field: GaussianField, camera: Camera, T_camera_world: Matrix, depth_reference: Tensor | None = None
    ) -> Render: ...


SurfacePredictor = Callable[[Camera, Matrix], Predicted]
"""Predicts the errors of a field from T_camera_world."""


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Surfaces seen from one pose, one sample per pixel [P]; edges and pixels without a surface are left out.

    points, normals [P, 3] m in the world, normals towards the camera; area_m2: area of the surface in the pixel; alpha;
    depth_sigma_m: the predicted standard deviation of depth; without a prediction √(U/A), the spread along the ray of
    the splats that make up the depth. wrong_share: the predicted probability that the colour is off by more than
    `WRONG_BY`, nan without a prediction.
    """

    T_world_camera: Matrix
    points: Floats
    normals: Floats
    area_m2: Floats
    alpha: Floats
    depth_sigma_m: Floats
    wrong_share: Floats


def sample_surfaces(
    field: GaussianField,
    trajectory: Trajectory,
    camera: Camera,
    renderer: SurfaceRenderer,
    max_poses: int = MAX_POSES,
    progress: Progress = no_progress,
    predictor: SurfacePredictor | None = None,
) -> Iterator[SurfaceSample]:
    """Sample from at most `max_poses` poses, evenly spaced over the path, including the first and the last."""
    small = camera.resized(WIDTH_PX, max(1, round(camera.height * WIDTH_PX / camera.width)))
    rows = np.unique(np.linspace(0, len(trajectory) - 1, min(max_poses, len(trajectory))).round().astype(int))
    for done, row in enumerate(rows, 1):
        yield sample_surface(field, small, trajectory.T_world_camera[row], renderer, predictor)
        progress(done, len(rows))


def sample_surface(
    field: GaussianField,
    camera: Camera,
    T_world_camera: Matrix,
    renderer: SurfaceRenderer,
    predictor: SurfacePredictor | None = None,
) -> SurfaceSample:
    """Sample from one pose: render depth, then its predicted error, or its spread without a predictor."""
    T_camera_world = se3.inverse(T_world_camera)
    with torch.inference_mode():
        seen = renderer(field, camera, T_camera_world)
        depth = (seen.depth / seen.alpha.clamp(min=COVERED_ALPHA)).float()
        alpha, depth_m = _array(seen.alpha), _array(depth)
        if predictor is None:
            spread = renderer(field, camera, T_camera_world, depth_reference=depth).uncertainty
            second = np.zeros_like(depth_m) if spread is None else _array(spread)
            sigma_m = np.sqrt(np.maximum(second, 0.0) / np.maximum(alpha, COVERED_ALPHA))
            wrong = np.full_like(depth_m, np.nan)
        else:
            predicted = predictor(camera, T_camera_world)
            sigma_m = _array(predicted.depth_std_m)
            wrong = probability_wrong(_array(predicted.color))
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


def probability_wrong(variance: Floats) -> Floats:
    """Return the probability that a Gaussian error of this variance (colour²) is larger than `WRONG_BY`."""
    return np.asarray(erfc(WRONG_BY / np.sqrt(2.0 * np.maximum(variance, 1e-12))), np.float32)


def _smooth(depth_m: Floats, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which inner pixels [H − 2, W − 2] lie on one surface with their four neighbours."""
    z, on = depth_m[1:-1, 1:-1], covered[1:-1, 1:-1].copy()
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        near = np.s_[rows : rows + z.shape[0], columns : columns + z.shape[1]]
        on &= covered[near] & (np.abs(depth_m[near] - z) < MAX_DEPTH_STEP * z)
    return on


def _array(values: Tensor) -> Floats:
    return np.asarray(values.detach().cpu(), np.float32)
