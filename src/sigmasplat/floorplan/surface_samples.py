"""Look at a map from places along its path: points on its surfaces, their normals, and how sure their depth is."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.metrics.scored_view import COVERED_ALPHA
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.render import Render
from sigmasplat.types import Matrix, Progress

WIDTH = 160
"""Pixels of an image that only measures: at 5 m one is about 4 cm wide."""
MOST = 60
EDGE = 0.05
"""Neighbours whose depths differ by more than this share belong to two surfaces, and what lies between to neither."""

Floats = NDArray[np.float32]


class Renderer(Protocol):
    """Shows a field from T_camera_world, with U about a depth [H, W] m if one is given (`render.render`)."""

    def __call__(
        self, field: GaussianField, camera: Camera, T_camera_world: Matrix, depth_reference: Tensor | None = None
    ) -> Render: ...


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """What one look shows of surfaces, pixel by pixel [P]: edges and what the map has nothing at are left out.

    points, normals [P, 3] m in the world, normals towards the camera; area_m2: of the surface in the pixel; alpha;
    depth_sigma_m: √(U/A), how far apart along the ray the splats lie that make the depth.
    """

    T_world_camera: Matrix
    points: Floats
    normals: Floats
    area_m2: Floats
    alpha: Floats
    depth_sigma_m: Floats


def looks(
    field: GaussianField,
    trajectory: Trajectory,
    camera: Camera,
    renderer: Renderer,
    most: int = MOST,
    progress: Progress = lambda done, total: None,
) -> Iterator[SurfaceSample]:
    """Look from at most so many poses, evenly spread over the path, first and last among them."""
    small = camera.resized(WIDTH, max(1, round(camera.height * WIDTH / camera.width)))
    rows = np.unique(np.linspace(0, len(trajectory) - 1, min(most, len(trajectory))).round().astype(int))
    for done, row in enumerate(rows, 1):
        yield look(field, small, trajectory.T_world_camera[row], renderer)
        progress(done, len(rows))


def look(field: GaussianField, camera: Camera, T_world_camera: Matrix, renderer: Renderer) -> SurfaceSample:
    """Look once: render depth, then how far it is spread about itself."""
    T_camera_world = se3.inverse(T_world_camera)
    with torch.inference_mode():
        seen = renderer(field, camera, T_camera_world)
        depth = (seen.depth / seen.alpha.clamp(min=COVERED_ALPHA)).float()
        spread = renderer(field, camera, T_camera_world, depth_reference=depth).uncertainty
    alpha, depth_m = _array(seen.alpha), _array(depth)
    second = np.zeros_like(depth_m) if spread is None else _array(spread)
    sigma_m = np.sqrt(np.maximum(second, 0.0) / np.maximum(alpha, COVERED_ALPHA))
    inner = np.s_[1:-1, 1:-1]
    on = _smooth(depth_m, alpha > COVERED_ALPHA)
    points = camera.rays() * depth_m[..., None]
    across = np.cross(points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2])[on]
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    normals = across / length[:, None]
    here = points[inner][on]
    normals *= -np.sign((normals * here).sum(1, keepdims=True))
    R, t = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3].astype(np.float32)
    measured = (here @ R.T + t, normals @ R.T, length / 4.0, alpha[inner][on], sigma_m[inner][on])
    return SurfaceSample(T_world_camera, *(np.asarray(values, np.float32) for values in measured))


def _smooth(depth_m: Floats, there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which inner pixels [H − 2, W − 2] lie on one surface with their four neighbours."""
    z, on = depth_m[1:-1, 1:-1], there[1:-1, 1:-1].copy()
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        near = np.s_[rows : rows + z.shape[0], columns : columns + z.shape[1]]
        on &= there[near] & (np.abs(depth_m[near] - z) < EDGE * z)
    return on


def _array(values: Tensor) -> Floats:
    return np.asarray(values.detach().cpu(), np.float32)
