"""Compare the surface of a run with the true surface: the distance of each vertex that the path sees."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from finished_run import FinishedRun, aligned_poses

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.data.trajectory import Trajectory, evenly_spread
from sigmasplat.final.fusion import TRUNCATION_VOXELS, VOXEL_M, count_keyframes, fuse, surface_views
from sigmasplat.final.tsdf import Tsdf, extract_surface
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.reconstruction import BEHIND_M, Mask, distances, visible_points
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.render import FieldRenderer
from sigmasplat.types import Matrix, Progress, no_progress

VERTICES = 100_000
"""At most this many vertices, drawn at random, are measured."""
REFERENCE_FRAMES = 100
"""At most this many frames, evenly spread, are fused into a reference surface."""
SEEING_FRAMES = 40
"""At most this many true poses, evenly spread, decide which vertices are visible."""


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """Vertices [V, 3] of a run's mesh, m, in the world, that the path sees, and their distance [V] to the reference,
    m. exact: the reference is the true surface; else it is fused from the sensor's depth at the true poses."""

    vertices: Matrix
    distance_m: Matrix
    exact: bool


def surface_errors(
    run: FinishedRun, source: Source, renderer: FieldRenderer, progress: Progress = no_progress
) -> SurfaceErrors | None:
    """Fuse the surface of a run as `sigmasplat mesh` does, and measure it; None without a true path.

    The true path is aligned to the estimated one with `aligned_poses`. A vertex counts if it is in the image of a true
    pose, at most `BEHIND_M` behind the reference, and if the reference has a surface at this pixel. Calls
    `progress(keyframes done, total)`.
    """
    truth, path = source.truth(), run.path.at(run.valid)
    if truth is None:
        return None
    rows, true_rows = associate(path.timestamps_s, truth.timestamps_s)
    if not len(rows):
        return None
    T_estimate_truth = aligned_poses(truth.T_world_camera[true_rows], path.T_world_camera[rows])
    surface = source.true_surface()
    reference = (_fused(run.config, source, truth) if surface is None else surface).moved(T_estimate_truth)
    part, anchors = run.part(run.members, refined=True), [run.anchors[s] for s in run.members]
    views = surface_views(lambda: run.field, part, anchors, run.config)
    found = fuse(views, count_keyframes(part), run.config, renderer=renderer, progress=progress)
    poses = T_estimate_truth @ truth.T_world_camera[evenly_spread(true_rows.tolist(), SEEING_FRAMES)]
    vertices = found.vertices.astype(np.float64)
    seen = np.flatnonzero(_seen(vertices, reference, run.camera, poses))
    vertices = vertices[np.random.default_rng(run.config.seed).permutation(seen)[:VERTICES]]
    return SurfaceErrors(vertices, distances(vertices, reference), surface is not None)


def _fused(config: Config, source: Source, truth: Trajectory) -> Mesh:
    """Fuse the sensor's depth at true poses into a surface in the frame of the truth."""
    volume = Tsdf(VOXEL_M, TRUNCATION_VOXELS * VOXEL_M)
    times = np.array([source.timestamp_s(i) for i in range(len(source))])
    rows, at = associate(times, truth.timestamps_s)
    for k in evenly_spread(range(len(rows)), REFERENCE_FRAMES):
        frame = working_frame(source, config.input, int(rows[k]))
        volume.integrate(frame.depth_m, frame.color, frame.camera, truth.T_world_camera[at[k]])
    return extract_surface(volume)


def _seen(vertices: Matrix, reference: Mesh, camera: Camera, T_world_camera: Iterable[Matrix]) -> Mask:
    """Return which vertices [V] are seen from a pose where the reference has a surface."""
    seen = np.zeros(len(vertices), bool)
    for T in T_world_camera:
        depth_m, _ = mesh_depth(reference, camera, se3.inverse(T))
        known = np.where(depth_m > 0, depth_m, np.float32(-np.inf))
        seen |= visible_points(vertices, known, camera, T, BEHIND_M)
    return seen
