"""Fuse a surface from the map: render at keyframes, integrate, extract, clean (VarSplat §7).

By default only renders of the map are fused. With `surface.depth=map+sensor` (ours) the readings of the keyframes are
fused too: the map averages the noise of many views and closes holes, a reading is sharp and has no bias of the fit.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.config.input import SENSORS, sensor_model
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.images import distance_std
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.submap import Picture, SubmapStore
from sigmasplat.final.tsdf import Tsdf, extract_surface
from sigmasplat.render import FieldRenderer, Render
from sigmasplat.types import Matrix, Progress, no_progress

VOXEL_M = 0.01
TRUNCATION_VOXELS = 4
"""VarSplat §7: 1 cm, truncated at 4 cm."""
MOST_BLOCKS, PIXEL_STEP, COARSE = 1 << 16, 4, 4
"""Largest number of blocks: 0.8 GB, and four times as much with the surface. They are counted in every fourth row and
column, for voxels four times as large, within 5 %."""
LEAST_ALPHA = 0.9
"""A pixel counts if its alpha reaches this value; its depth is then Σwz / Σw."""
STEP_SHARE, AGREE_SHARE, RENDER_WEIGHT = 0.05, 0.05, np.float32(1.0)
"""Of fusion with readings: `silhouettes`, `with_readings`; the variance of a reading by that of a render."""
LEAST_VERTICES = 200
"""Connected parts with fewer vertices are dropped (VarSplat §7)."""
FLOATER_SHARE = 5e-4
"""With readings, parts below this share of the largest part's area are dropped too: 300 cm² in a room of 60 m²."""

Floats = NDArray[np.float32]
Renderer = Callable[[GaussianField, Camera, Matrix], Render]


@dataclass(frozen=True, eq=False)
class FusionView:
    """A view to render and fuse: a field, a camera, and its pose in the field's frame and in the world; picture: the
    recorded images of the view, if they are fused too, and their exposure [3, 2] (`data.camera`; None: the map's)."""

    field: GaussianField
    camera: Camera
    T_camera_field: Matrix
    T_world_camera: Matrix
    picture: Picture | None = None
    exposure: Matrix | None = None


def surface_views(
    read_field: Callable[[], GaussianField], store: SubmapStore, anchors: Sequence[Matrix], config: Config,
    outside: Collection[int] = (), T_world_keyframe: Matrix | None = None, exposures: Matrix | None = None,
) -> Iterator[FusionView]:  # fmt: skip
    """Yield the views of a finished run's surface at its keyframes, as `surface.depth` says.

    read_field: returns the final map in the world, called if it is fused; anchors: T_world_submap of each submap;
    outside: the submaps that are not connected to the world, which are skipped; T_world_keyframe [K, 4, 4]: the poses
    of all keyframes of all submaps, if the final map has moved them; exposures [F, 3, 2]: those of all frames.
    """
    if config.surface.depth == "map":
        yield from fusion_views(store, anchors, outside)
        return
    field, first = read_field(), 0
    for index in range(len(store)):
        submap = store.load(index)
        poses = anchors[index] @ submap.T_submap_camera
        if T_world_keyframe is not None:
            poses = T_world_keyframe[first : first + len(poses)]
        first += len(poses)
        for k, T in enumerate(poses) if index not in outside else ():
            frame = submap.frames[k]  # below 0: of an earlier session
            exposure = None if exposures is None or frame < 0 else exposures[frame]
            yield FusionView(field, submap.camera, se3.inverse(T), T, store.picture(index, k), exposure)


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


def voxel_edge(views: Iterable[FusionView], config: Config) -> float:
    """Return the edge of a voxel for a surface of these views, m.

    It is 1 cm, times the scale of the scene (VarSplat §7). With readings it is less if they show more: the width of a
    working pixel at their median depth. It is not below half the standard deviation of a reading there, so that the
    truncation of 4 voxels contains most readings of one surface. It is more in a scene that would need more than
    `MOST_BLOCKS`. An unknown sensor is taken for one of structured light.
    """
    seen, step = list[tuple[Floats, Floats, Matrix]](), slice(None, None, PIXEL_STEP)
    focal_px = 1.0
    for at in views:
        depth_m = np.empty((0, 0), np.float32) if at.picture is None else at.picture.depth_m[step, step]
        if depth_m.any():
            rays, focal_px = at.camera.rays()[step, step][depth_m > 0], at.camera.fx
            seen.append((rays, depth_m[depth_m > 0], at.T_world_camera))
    voxel_m = VOXEL_M * config.render.scene_scale
    if not seen:
        return voxel_m
    median_m = float(np.median(np.concatenate([depth_m for _, depth_m, _ in seen])))
    std_m = distance_std(np.full(1, median_m, np.float32), sensor_model(config.input.sensor) or SENSORS["kinect-v1"])
    voxel_m = min(voxel_m, max(median_m / focal_px, float(std_m[0]) / 2))
    coarse = Tsdf(COARSE * voxel_m, TRUNCATION_VOXELS * COARSE * voxel_m)
    for rays, depth_m, T_world_camera in seen:
        coarse.allocate(rays, depth_m, T_world_camera)
    return voxel_m * max(1.0, COARSE * float(np.sqrt(len(coarse) / MOST_BLOCKS)))


def fuse(
    views: Iterable[FusionView], total: int, config: Config, *, voxel_m: float | None = None,
    renderer: Renderer | None = None, progress: Progress = no_progress,
) -> Mesh:  # fmt: skip
    """Fuse depth and colour, rendered at `total` views, into a mesh in the world.

    A view with a picture is fused with its readings (`with_readings`). Depth outside the range of the input settings is
    ignored. Calls `progress(views done, total)`. voxel_m None: 1 cm, times the scale of the scene (`voxel_edge`: by the
    readings). Raises ConfigError unless it is above 0.
    """
    voxel_m = VOXEL_M * config.render.scene_scale if voxel_m is None else voxel_m
    volume = Tsdf(voxel_m, TRUNCATION_VOXELS * voxel_m)
    renderer = renderer or FieldRenderer(config.render, config.backend)
    for done, at in enumerate(views, 1):
        with torch.inference_mode():
            seen = renderer(at.field, at.camera, at.T_camera_field)
        depth_m, color = surface_of(seen, config)
        weight = None
        if at.picture is not None:
            picture = at.picture if at.exposure is None else at.picture.without_exposure(at.exposure)
            depth_m, color, weight = with_readings(depth_m, color, picture)
        volume.integrate(depth_m, color, at.camera, at.T_world_camera, weight)
        progress(done, total)
    mesh = extract_surface(volume)
    del volume  # free memory: cleaning needs as much again
    return mesh.without_small_parts(LEAST_VERTICES, FLOATER_SHARE if config.surface.depth == "map+sensor" else 0.0)


def surface_of(seen: Render, config: Config) -> tuple[Floats, Floats]:
    """Return depth [H, W] in m (0 = no surface) and colour [H, W, 3] of the opaque surfaces in a render."""
    alpha = _array(seen.alpha)
    opaque = np.maximum(alpha, LEAST_ALPHA)
    depth_m = np.where(alpha >= LEAST_ALPHA, _array(seen.depth) / opaque, np.float32(0.0))
    depth_m[(depth_m < config.input.min_depth_m) | (depth_m > config.input.max_depth_m)] = 0.0
    return depth_m, np.clip(_array(seen.color) / opaque[..., None], 0.0, 1.0)


def with_readings(depth_m: Floats, color: Floats, picture: Picture) -> tuple[Floats, Floats, Floats]:
    """Combine rendered depth [H, W] and colour [H, W, 3] with a keyframe's readings; return both and the weight [H, W].

    Depth is the mean of the render and the reading, weighted by the inverse of their variances. Where they differ by
    more than `AGREE_SHARE` of the depth, only the reading counts; where there is no reading, only the render. A render
    has no depth at silhouettes: a pixel there mixes two surfaces.
    """
    reading_m = picture.depth_m
    rendered_m = np.where(silhouettes(depth_m), np.float32(0.0), depth_m)
    of_reading = _inverse_variance(reading_m)
    agree = np.abs(rendered_m - reading_m) < AGREE_SHARE * reading_m
    of_render = np.where((reading_m > 0) & ~agree, np.float32(0.0), RENDER_WEIGHT * _inverse_variance(rendered_m))
    weight = of_reading + of_render
    mean_m = (of_reading * reading_m + of_render * rendered_m) / np.maximum(weight, np.float32(1e-12))
    shown = np.where(reading_m[..., None] > 0, picture.unit_color, color)
    return np.asarray(mean_m, np.float32), np.asarray(shown, np.float32), np.asarray(weight, np.float32)


def silhouettes(depth_m: Floats) -> NDArray[np.bool_]:
    """Return the pixels [H, W] whose depth differs from that of a neighbour by more than `STEP_SHARE` of it."""
    out = np.zeros(depth_m.shape, bool)
    for axis in (0, 1):
        near, far = np.moveaxis(depth_m, axis, 0)[:-1], np.moveaxis(depth_m, axis, 0)[1:]
        step = np.abs(near - far) > STEP_SHARE * np.minimum(near, far)
        marked = np.moveaxis(out, axis, 0)
        marked[:-1] |= step
        marked[1:] |= step
    return out


def _inverse_variance(depth_m: Floats) -> Floats:
    """Return the inverse variance of depth [H, W] relative to that at 1 m, 0 without depth: structured light
    (Nguyen 2012)."""
    sigma = 1.2 + 1.9 * (depth_m - np.float32(0.4)) ** 2
    return np.where(depth_m > 0, (np.float32(1.2 + 1.9 * 0.36) / sigma) ** 2, np.float32(0.0)).astype(np.float32)


def _array(values: Tensor) -> Floats:
    return np.asarray(values.cpu(), np.float32)
