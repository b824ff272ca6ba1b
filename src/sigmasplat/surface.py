"""Make a surface of a run's map: render depth and colour at every keyframe, fuse, cut, clean (VarSplat §7).

What is fused is the map's own view, never a recorded image nor the truth.
"""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.errors import RunError
from sigmasplat.io.mesh import write_mesh
from sigmasplat.io.runs import MESH, RunFolder
from sigmasplat.metrics import reconstruction
from sigmasplat.metrics.trajectory import align_rigid, associate, paired
from sigmasplat.model import isosurface, se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.mesh import Mesh
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.model.tsdf import Tsdf
from sigmasplat.render import Render, render

VOXEL_M = 0.01
TRUNCATION_VOXELS = 4
"""VarSplat §7: 1 cm, truncated at 4 cm."""
LEAST_ALPHA = 0.9
"""A pixel counts where the map stops this share of the light; depth is then Σwz / Σw."""
LEAST_VERTICES = 200
"""Smaller parts are dropped (VarSplat §7)."""

Renderer = Callable[[GaussianField, Camera, NDArray[np.float64]], Render]
Progress = Callable[[int, int], None]


def reconstruct(
    run: RunFolder,
    camera: Camera,
    *,
    voxel_m: float = VOXEL_M,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> Mesh:
    """Fuse what the run's map shows at its keyframes into a mesh in the run's world; `camera` is the source's.

    `progress` is told (keyframes done, of how many). Raises RunError if the run has no map, no checkpoint or no
    keyframe; ConfigError unless voxel_m > 0.
    """
    volume = Tsdf(voxel_m, TRUNCATION_VOXELS * voxel_m)
    field, poses, config = run.read_map(), keyframe_poses(run), run.config()
    seen_by = working_camera(run, camera)
    renderer = renderer or partial(render, options=config.render, backend=config.backend)
    for done, T_world_camera in enumerate(poses, 1):
        with torch.inference_mode():
            seen = renderer(field, seen_by, se3.inverse(T_world_camera))
        alpha = _array(seen.alpha)
        opaque = np.maximum(alpha, LEAST_ALPHA)
        depth_m = np.where(alpha >= LEAST_ALPHA, _array(seen.depth) / opaque, np.float32(0.0))
        depth_m[(depth_m < config.input.min_depth_m) | (depth_m > config.input.max_depth_m)] = 0.0
        color = np.clip(_array(seen.color) / opaque[..., None], 0.0, 1.0)
        volume.integrate(depth_m, color, seen_by, T_world_camera)
        progress(done, len(poses))
    mesh = isosurface.surface(volume)
    del volume  # cleaning takes as much memory again
    return mesh.without_small_parts(LEAST_VERTICES)


def keyframe_poses(run: RunFolder) -> NDArray[np.float64]:
    """Return T_world_camera [K, 4, 4] of the frames that the run mapped, as known at its end. Raises RunError."""
    tensors, _ = run.read_checkpoint()
    if not {"keyframes", "T_world_camera"} <= set(tensors) or not len(tensors["keyframes"]):
        raise RunError(f"run {run.path} has no keyframes in its checkpoint; run it again")
    return np.asarray(tensors["T_world_camera"][tensors["keyframes"]], np.float64)


def fuse_and_score(
    run: RunFolder,
    camera: Camera,
    true_surface: Mesh | None,
    true_path: Trajectory | None,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> dict[str, Any] | None:
    """Write the run's mesh.ply and return its scores; None unless both the true surface and the true path are known."""
    mesh = reconstruct(run, camera, renderer=renderer, progress=progress)
    write_mesh(run.path / MESH, mesh)
    if true_surface is None or true_path is None:
        return None
    return asdict(score(run, camera, mesh, true_surface, true_path, progress))


def score(
    run: RunFolder,
    camera: Camera,
    mesh: Mesh,
    true_surface: Mesh,
    true_path: Trajectory,
    progress: Progress = lambda done, total: None,
) -> reconstruction.Reconstruction:
    """Score a run's mesh against the true surface (`metrics.reconstruction`), aligned as its path is for the ATE.

    Training views are the true poses of the keyframes. Raises SourceError if path and truth share no timestamps.
    """
    path = run.read_trajectory()
    ours, theirs = paired(path, true_path)
    T_truth_world = align_rigid(ours[:, :3, 3], theirs[:, :3, 3])
    tensors, _ = run.read_checkpoint()
    _, rows = associate(tensors["timestamps_s"][tensors["keyframes"]].numpy(), true_path.timestamps_s)
    views = true_path.T_world_camera[rows]
    seen_by = working_camera(run, camera)
    return reconstruction.score(mesh.moved(T_truth_world), true_surface, seen_by, views, progress=progress)


def working_camera(run: RunFolder, camera: Camera) -> Camera:
    """Return the camera of the images that the run worked on, of the source's (as `Frame.prepared` makes it)."""
    width = run.config().input.width
    return camera.resized(width, round(camera.height * width / camera.width)) if width else camera


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.asarray(values.cpu(), np.float32)
