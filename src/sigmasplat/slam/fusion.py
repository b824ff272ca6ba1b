"""Fuse what maps show at their keyframes into a surface: render, integrate, cut, clean (VarSplat §7).

What is fused is the map's own view, never a recorded image.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
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
from sigmasplat.types import Matrix, Progress

VOXEL_M = 0.01
TRUNCATION_VOXELS = 4
"""VarSplat §7: 1 cm, truncated at 4 cm."""
LEAST_ALPHA = 0.9
"""A pixel counts where the map stops this share of the light; depth is then Σwz / Σw."""
LEAST_VERTICES = 200
"""Smaller parts are dropped (VarSplat §7)."""

Floats = NDArray[np.float32]
Renderer = Callable[[GaussianField, Camera, Matrix], Render]


@dataclass(frozen=True, eq=False)
class FusionView:
    """Where a map is looked at from: T_camera_field in the frame of its field, T_world_camera in the world."""

    field: GaussianField
    camera: Camera
    T_camera_field: Matrix
    T_world_camera: Matrix


def fusion_views(store: SubmapStore, anchors: Sequence[Matrix]) -> Iterator[FusionView]:
    """Return every keyframe of all submaps before its own submap, one of which is in memory at a time.

    anchors: T_world_submap of each.
    """
    for index in range(len(store)):
        submap = store.load(index)
        for T_submap_camera in submap.T_submap_camera:
            T_world_camera = anchors[index] @ T_submap_camera
            yield FusionView(submap.field, submap.camera, se3.inverse(T_submap_camera), T_world_camera)


def count_keyframes(store: SubmapStore) -> int:
    """Return how many keyframes all submaps have."""
    return sum(len(store.load(index).frames) for index in range(len(store)))


def fuse(
    standpoints: Iterable[FusionView],
    total: int,
    config: Config,
    *,
    voxel_m: float = VOXEL_M,
    weigh: bool = False,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> Mesh:
    """Fuse depth and colour rendered at `total` standpoints into a mesh in the world.

    Readings out of the input's range are none. weigh: count pixels by how sure their map is of their colour, w̃ with the
    τ of tracking (VarSplat §3). `progress` is told (standpoints done, total). Raises ConfigError unless voxel_m > 0.
    """
    volume = Tsdf(voxel_m, TRUNCATION_VOXELS * voxel_m)
    renderer = renderer or FieldRenderer(config.render, config.backend)
    for done, at in enumerate(standpoints, 1):
        with torch.inference_mode():
            seen = renderer(at.field, at.camera, at.T_camera_field)
        depth_m, color = surface_of(seen, config)
        weight = certainty(seen, config) if weigh else None
        volume.integrate(depth_m, color, at.camera, at.T_world_camera, weight)
        progress(done, total)
    mesh = isosurface.surface(volume)
    del volume  # cleaning takes as much memory again
    return mesh.without_small_parts(LEAST_VERTICES)


def surface_of(seen: Render, config: Config) -> tuple[Floats, Floats]:
    """Return the depth [H, W] m, 0 = none, and the colour [H, W, 3] of what stops the light in a render."""
    alpha = _array(seen.alpha)
    opaque = np.maximum(alpha, LEAST_ALPHA)
    depth_m = np.where(alpha >= LEAST_ALPHA, _array(seen.depth) / opaque, np.float32(0.0))
    depth_m[(depth_m < config.input.min_depth_m) | (depth_m > config.input.max_depth_m)] = 0.0
    return depth_m, np.clip(_array(seen.color) / opaque[..., None], 0.0, 1.0)


def certainty(seen: Render, config: Config) -> Floats:
    """Weigh the pixels [H, W] of a render by its variance: w̃, mean over the channels, median over its surfaces."""
    c, opaque = config.tracking, seen.alpha >= LEAST_ALPHA
    return _array(uncertainty_weights(seen.variance, opaque, c.tau, c.weight_max).mean(-1))


def _array(values: Tensor) -> Floats:
    return np.asarray(values.cpu(), np.float32)
