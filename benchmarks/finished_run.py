"""Run SLAM in memory and keep what is measured of it afterwards: maps, path, which frames were held back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import MemoryStore, SubmapStore
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.final.stores import RefinedStore, StorePart
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import associate, score_failures, truth_in_estimate
from sigmasplat.plugins.evaluation.path_scores import score_path_covariance
from sigmasplat.run.callbacks import Callback
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.keyframe_rule import is_held_back
from sigmasplat.types import Matrix, no_progress
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """What is measured of a run: its settings, maps and path.

    field: the final map in the world; store: its submaps; anchors: T_world_submap of each; members: the submaps that
    are connected to the world; refined: T_submap_camera of their keyframes as the final map has moved them, by submap;
    exposures: those of the same keyframes [K, 3, 2] relative to the final map; frame_exposures [F, 3, 2];
    submap_of [F], T_submap_camera [F, 4, 4]: the submap of each frame and its pose there; valid [F]: whether its
    pose is valid; indices [F]: its number in the source; p_off [F]; uncertainty: how sure the final map is, if it
    was measured; errors: those of the path; keyframes: their rows.
    """

    config: Config
    camera: Camera
    field: GaussianField
    store: SubmapStore
    anchors: list[Matrix]
    members: list[int]
    refined: dict[int, list[Matrix]]
    exposures: dict[int, Matrix]
    frame_exposures: Matrix
    path: Trajectory
    submap_of: list[int]
    T_submap_camera: Matrix
    valid: NDArray[np.bool_]
    indices: list[int]
    p_off: NDArray[np.float64]
    counts: dict[str, int]
    uncertainty: MapUncertainty | None
    errors: PathCovariance | None
    keyframes: list[int]

    @staticmethod
    def of(slam: Slam) -> "FinishedRun":
        """Read a system after its last frame and `finish`. The only submap of a run without cuts is finished here."""
        store = slam.store
        if not len(store):
            store = MemoryStore()
            store.save(*slam.mapper.finished(0))
        counts = {
            "frames": len(slam.steps), "lost": int(slam.steps.lost.sum()),
            "keyframes": len(slam.keyframe_indices), "submaps": len(store), "splats": len(slam.field),
        }  # fmt: skip
        return FinishedRun(
            slam.config, slam.view.camera, slam.field, store, list(slam.atlas.anchors), slam.atlas.members(0),
            slam.atlas.refined, slam.atlas.exposures, slam.atlas.frame_exposures(), slam.trajectory(),
            slam.atlas.places.submap.tolist(), slam.atlas.T_submap_camera, slam.valid(),
            slam.steps.frame.tolist(), slam.steps.p_off, counts,
            slam.uncertainty, PathCovariance.of(slam.checkpoint()), slam.keyframe_indices,
        )  # fmt: skip

    def part(self, members: Sequence[int], refined: bool = False) -> SubmapStore:
        """Return some submaps; with `refined`, as the final map sees them: with its keyframe poses and in its
        exposure."""
        part = StorePart(self.store, members)
        if not refined:
            return part
        poses = [self.refined[s] for s in members] if self.refined else None
        return RefinedStore(part, poses, [self.exposures[s] for s in members] if self.exposures else None)

    @property
    def held_back(self) -> list[int]:
        """List the frames that were held back from the map."""
        every = self.config.input.hold_every
        return [row for row in range(len(self.indices)) if is_held_back(row, every)]


def run_slam(config: Config, source: Source, show: Callback | None = None) -> FinishedRun:
    """Run SLAM in memory, including the final map."""
    slam = Slam(config)
    for frame in source:
        step = slam.step(frame)
        if show:
            show(step)
    slam.finish(show.finishing if show else no_progress)
    return FinishedRun.of(slam)


def run_facts(run: FinishedRun, source: Source) -> dict[str, Any]:
    """Return counts, and, if the truth is known, the scores of positions ("ate_m"), of `p_off` ("failures") and of the
    covariance of poses ("poses")."""
    unknown = {"ate_m": None, "failures": None, "poses": None}
    return run.counts | {"held_back": len(run.held_back)} | unknown | _path_scores(run, source)


def _path_scores(run: FinishedRun, source: Source) -> dict[str, Any]:
    """Return the ATE, the scores of `p_off` and of the covariance of poses; nothing without a truth that shares
    timestamps with the path."""
    truth, valid = source.truth(), run.valid
    if truth is None or not valid.any():
        return {}
    times, positions = run.path.timestamps_s, run.path.T_world_camera[:, :3, 3]
    rows, matched = associate(times, truth.timestamps_s)
    if not valid[rows].any():
        return {}
    T_estimate_truth = truth_in_estimate(times[valid], positions[valid], truth)
    true = (T_estimate_truth @ truth.T_world_camera[matched])[:, :3, 3]
    error_m = np.full(len(times), np.nan)
    error_m[rows] = np.linalg.norm(positions[rows] - true, axis=1)
    at = np.isfinite(error_m) & valid
    ate_m = float(np.sqrt(np.mean(error_m[at] ** 2)))
    found = {"ate_m": ate_m, "failures": score_failures(error_m, run.p_off, valid)}
    if run.errors is not None:
        at = np.flatnonzero(valid)
        found["poses"] = score_path_covariance(run.errors, run.path.at(at), at, run.keyframes, truth)
    return found


def aligned_poses(T_truth_camera: Matrix, T_estimate_camera: Matrix) -> Matrix:
    """Return T_estimate_truth [4, 4] from poses [K, 4, 4] of the same frames: the mean rotation, and the mean shift.

    The alignment of the ATE uses positions only. On a short or straight path they do not fix the rotation, which would
    move views and surfaces by more than their errors.
    """
    rotations = T_estimate_camera[:, :3, :3] @ T_truth_camera[:, :3, :3].swapaxes(1, 2)
    u, _, vt = np.linalg.svd(rotations.sum(0))
    found = np.eye(4)
    found[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    found[:3, 3] = (T_estimate_camera[:, :3, 3] - T_truth_camera[:, :3, 3] @ found[:3, :3].T).mean(0)
    return found
