"""Fuse a surface from the map: render at keyframes, integrate, extract, clean (VarSplat §7).

Only renders of the map are fused, never recorded images.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.fit.confidence import uncertainty_weights
from sigmasplat.model import isosurface, se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.mesh import Mesh
from sigmasplat.model.submap import SubmapStore
from sigmasplat.model.tsdf import Tsdf
from sigmasplat.render import FieldRenderer, Render
from sigmasplat.types import Matrix, Progress, no_progress

VOXEL_M = 0.01
TRUNCATION_VOXELS = 4
"""VarSplat §7: 1 cm, truncated at 4 cm."""
LEAST_ALPHA = 0.9
"""A pixel counts if its alpha reaches this value; its depth is then Σwz / Σw."""
LEAST_VERTICES = 200
"""Connected parts with fewer vertices are dropped (VarSplat §7)."""

Floats = NDArray[np.float32]
Renderer = Callable[[GaussianField, Camera, Matrix], Render]


@dataclass(frozen=True, eq=False)
class FusionView:
    """A view to render and fuse: a field, a camera, and its pose in the field's frame and in the world."""

    field: GaussianField
    camera: Camera
    T_camera_field: Matrix
    T_world_camera: Matrix


def fusion_views(store: SubmapStore, anchors: Sequence[Matrix], outside: Collection[int] = ()) -> Iterator[FusionView]:
    """Yield a view of each submap at each of its keyframes; one submap is in memory at a time.

    anchors: T_world_submap of each submap; outside: the submaps that are not connected to the world, which are skipped.
    """
    for index in _inside(store, outside):
        submap = store.load(index)
        for T_submap_camera in submap.T_submap_camera:
            T_world_camera = anchors[index] @ T_submap_camera
            yield FusionView(submap.field, submap.camera, se3.inverse(T_submap_camera), T_world_camera)


def count_keyframes(store: SubmapStore, outside: Collection[int] = ()) -> int:
    """Return the number of keyframes in all submaps except those in `outside`."""
    return sum(len(store.load(index).frames) for index in _inside(store, outside))


def _inside(store: SubmapStore, outside: Collection[int]) -> list[int]:
    return [index for index in range(len(store)) if index not in outside]


def fuse(
    views: Iterable[FusionView],
    total: int,
    config: Config,
    *,
    voxel_m: float = VOXEL_M,
    weigh: bool = False,
    renderer: Renderer | None = None,
    progress: Progress = no_progress,
) -> Mesh:
    """Fuse depth and colour, rendered at `total` views, into a mesh in the world.

    Depth outside the range of the input settings is ignored. weigh: weight pixels by their colour uncertainty, w̃ with
    the τ of tracking (VarSplat §3). Calls `progress(views done, total)`. Raises ConfigError unless voxel_m > 0.
    """
    volume = Tsdf(voxel_m, TRUNCATION_VOXELS * voxel_m)
    renderer = renderer or FieldRenderer(config.render, config.backend)
    for done, at in enumerate(views, 1):
        with torch.inference_mode():
            seen = renderer(at.field, at.camera, at.T_camera_field)
        depth_m, color = surface_of(seen, config)
        weight = certainty(seen, config) if weigh else None
        volume.integrate(depth_m, color, at.camera, at.T_world_camera, weight)
        progress(done, total)
    mesh = isosurface.surface(volume)
    del volume  # free memory: cleaning needs as much again
    return mesh.without_small_parts(LEAST_VERTICES)


def surface_of(seen: Render, config: Config) -> tuple[Floats, Floats]:
    """Return depth [H, W] in m (0 = no surface) and colour [H, W, 3] of the opaque surfaces in a render."""
    alpha = _array(seen.alpha)
    opaque = np.maximum(alpha, LEAST_ALPHA)
    depth_m = np.where(alpha >= LEAST_ALPHA, _array(seen.depth) / opaque, np.float32(0.0))
    depth_m[(depth_m < config.input.min_depth_m) | (depth_m > config.input.max_depth_m)] = 0.0
    return depth_m, np.clip(_array(seen.color) / opaque[..., None], 0.0, 1.0)


def certainty(seen: Render, config: Config) -> Floats:
    """Return a weight per pixel [H, W] from the render's variance V: w̃, averaged over the colour channels."""
    c, opaque = config.tracking, seen.alpha >= LEAST_ALPHA
    return _array(uncertainty_weights(seen.variance, opaque, c.tau, c.weight_max).mean(-1))


def _array(values: Tensor) -> Floats:
    return np.asarray(values.cpu(), np.float32)
