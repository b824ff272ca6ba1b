"""Extract a surface from a run's map: render depth and colour at every keyframe, fuse, mesh, clean (VarSplat §7).

The ground truth is never fused, only images rendered from the map and, with `surface.depth=map+sensor`, those of the
keyframes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

import sigmasplat.api as api
from sigmasplat.api import Camera, FusionView, Mesh, Progress, Renderer, RunError, RunFolder, Trajectory, se3
from sigmasplat.plugins.evaluation.metrics import reconstruction
from sigmasplat.plugins.evaluation.metrics.published_reconstruction import VIEWS, score_published
from sigmasplat.plugins.evaluation.metrics.reconstruction import score_splats
from sigmasplat.plugins.evaluation.metrics.trajectory import align_rigid, associate, pair_poses
from sigmasplat.plugins.outputs.mesh_files import read_mesh, write_mesh

OPAQUE = 0.5
LARGEST_EDGE_M = 0.1
"""Larger true faces are divided: whether a part of the surface was seen is decided for each face."""


@dataclass(frozen=True, eq=False)
class FusionInput:
    """What fusion needs from a run, read once: settings, checkpoint, and the camera of its working images."""

    run: RunFolder
    config: api.Config
    checkpoint: dict[str, Tensor]
    camera: Camera

    @staticmethod
    def of(run: RunFolder, camera: Camera) -> "FusionInput":
        """Read a run; `camera` is the source's camera. Raises RunError if it has no checkpoint or no keyframe."""
        settings = run.config().input
        return FusionInput.at(run, camera.prepared(settings.width, settings.crop_px))

    @staticmethod
    def at(run: RunFolder, camera: Camera) -> "FusionInput":
        """Read a run; `camera` is that of its working images. Raises RunError as `of` does."""
        config, (checkpoint, _) = run.config(), run.read_checkpoint()
        if not {"keyframes", "T_world_camera"} <= set(checkpoint) or not len(checkpoint["keyframes"]):
            raise RunError(f"run {run.path} has no keyframes in its checkpoint; run it again")
        return FusionInput(run, config, checkpoint, camera)

    def views(self) -> tuple[Iterable[FusionView], int]:
        """Return the views to fuse (`surface_views`) and their number; without submaps, renders of the one map.

        Submaps that are not connected to the world are left out.
        Raises RunError if there is no map, or if the checkpoint lacks the pose of a submap.
        """
        submaps, tensors = self.run.submaps, self.checkpoint
        if not len(submaps):
            field, poses = self.run.read_map(), np.asarray(tensors["T_world_camera"][tensors["keyframes"]], np.float64)
            return [FusionView(field, self.camera, se3.inverse(T), T) for T in poses], len(poses)
        anchors = np.asarray(tensors.get("T_world_submap", np.empty((0, 4, 4))), np.float64)
        if len(anchors) < len(submaps):
            raise RunError(
                f"run {self.run.path} has {len(submaps)} submaps, but its checkpoint has poses of {len(anchors)}; "
                "run it again"
            )
        outside = self.run.read_frames().submaps_outside() if self.run.component_numbers() else frozenset[int]()
        T_world_keyframe, exposures = (
            None if name not in tensors else np.asarray(tensors[name], np.float64)
            for name in ("T_world_keyframe", "exposure")
        )
        views = api.surface_views(
            self.run.read_map, submaps, list(anchors), self.config, outside, T_world_keyframe, exposures
        )
        return views, api.count_keyframes(submaps, outside)

    def surface(
        self, voxel_m: float | None = None, renderer: Renderer | None = None, progress: Progress = api.no_progress
    ) -> Mesh:
        """Fuse renders of the map at the keyframes into a mesh in the run's world.

        Its vertices have the depth_std_m of the nearest opaque splat, if the run has measured it. Calls
        `progress(done, total)` with keyframes. voxel_m None: `voxel_edge`. Raises RunError as `views` does; ConfigError
        unless voxel_m > 0.
        """
        voxel_m = api.voxel_edge(self.views()[0], self.config) if voxel_m is None else voxel_m
        views, total = self.views()
        mesh = api.fuse(views, total, self.config, voxel_m=voxel_m, renderer=renderer, progress=progress)
        field, std = self.run.read_splat_std() or (None, None)
        nearest = None if field is None else nearest_opaque(field, mesh.vertices.astype(np.float64))
        if std is None or nearest is None:
            return mesh
        return replace(mesh, depth_std_m=std.depth_std_m.numpy()[nearest].astype(np.float32))


def nearest_opaque(field: api.GaussianField, points: api.Matrix) -> NDArray[np.intp] | None:
    """Return the nearest splat [V] to each point [V, 3], m, whose opacity is at least ½; None if there is none."""
    opaque = np.flatnonzero((field.opacities >= OPAQUE).cpu().numpy())
    if not len(opaque):
        return None
    _, nearest = cKDTree(field.means.detach().cpu().double().numpy()[opaque]).query(points)
    return np.asarray(opaque[nearest], np.intp)


def known_surface(source: api.Source) -> Mesh | None:
    """Return the true surface of a source: exact, or read from the file beside the sequence; None without one.

    Raises SourceError if the file cannot be read.
    """
    path = source.true_surface_file()
    return source.true_surface() if path is None else read_mesh(path)


def fuse_and_score(
    run: RunFolder, camera: Camera, true_surface: Mesh | None, true_path: Trajectory | None, random_views: int = VIEWS,
    renderer: Renderer | None = None, progress: Progress = api.no_progress,
) -> dict[str, Any]:  # fmt: skip
    """Write the run's mesh.ply and return its scores, as `score` does; they are None if the true surface or the true
    path is unknown."""
    fusion_input = FusionInput.of(run, camera)
    mesh = fusion_input.surface(None, renderer, progress)
    write_mesh(run.path / api.MESH, mesh)
    if true_surface is None or true_path is None:
        return {"reconstruction": None, "reconstruction_published": None}
    return score(fusion_input, mesh, true_surface, true_path, random_views, progress)


def score(
    fusion_input: FusionInput, mesh: Mesh, true_surface: Mesh, true_path: Trajectory, random_views: int = VIEWS,
    progress: Progress = api.no_progress,
) -> dict[str, Any]:  # fmt: skip
    """Score a run's mesh and its splats against the true surface, after the same alignment as for the ATE.

    Returns `reconstruction`, our scores, and `reconstruction_published`, those of the papers' protocol. The training
    views are the true poses of the keyframes. Raises SourceError if path and truth share no timestamps.
    """
    frames, tensors = fusion_input.run.read_frames(), fusion_input.checkpoint
    ours, theirs = pair_poses(frames.path, true_path)
    T_truth_world = align_rigid(ours[:, :3, 3], theirs[:, :3, 3])
    keyframes = tensors["keyframes"].numpy()
    keyframes = keyframes[frames.valid[keyframes]]
    _, rows = associate(tensors["timestamps_s"].numpy()[keyframes], true_path.timestamps_s)
    truth, found = true_surface.subdivided(LARGEST_EDGE_M), mesh.moved(T_truth_world)
    field = fusion_input.run.read_map()
    centers = field.means.numpy().astype(np.float64) @ T_truth_world[:3, :3].T + T_truth_world[:3, 3]
    reference = truth, fusion_input.camera, true_path.T_world_camera[rows]
    points = np.concatenate([found.corners.mean(1), centers])
    seen_true, seen_points = reconstruction.visible_parts(truth, points, *reference[1:], progress)
    seen_found, seen_splats = seen_points[: len(found.faces)], seen_points[len(found.faces) :]
    of_mesh = reconstruction.score(found, *reference, seen=(seen_true, seen_found))
    opacities = field.opacities.numpy().astype(np.float64)
    of_splats = score_splats(centers, opacities, *reference, seen=(seen_true, seen_splats))
    published = score_published(found, truth, seen_true, seen_found, views=random_views, progress=progress)
    return {"reconstruction": of_mesh | of_splats, "reconstruction_published": published}
