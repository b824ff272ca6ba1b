"""Collect views that a map was not fitted to: frames that were held back, and test views of the source."""

from dataclasses import dataclass, field, replace

import numpy as np
from finished_run import FinishedRun, aligned_poses

from sigmasplat.config import Config
from sigmasplat.data.camera import NEUTRAL
from sigmasplat.data.frame import Frame
from sigmasplat.data.images import resized_depth
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class UnseenView:
    """A recorded view to predict, and its pose in the world; exact: whether its depth is the true depth;
    T_submap_camera: the pose of a frame of the run in its submap; exposure [3, 2]: relative to the final map."""

    frame: Frame
    T_world_camera: Matrix
    submap: int
    exact: bool
    T_submap_camera: Matrix = field(default_factory=lambda: np.eye(4))
    exposure: Matrix = field(default_factory=NEUTRAL.copy)


def held_back_views(run: FinishedRun, source: Source, most: int) -> list[UnseenView]:
    """Return the frames that were held back and whose pose is valid, evenly spread, at the estimated poses."""
    rows = [row for row in run.held_back if run.valid[row]]
    return [
        replace(
            _unseen_view(run.config, source, run.indices[row], run.path.T_world_camera[row], run.submap_of[row]),
            T_submap_camera=run.T_submap_camera[row],
            exposure=run.frame_exposures[row],
        )
        for row in evenly_spread(rows, most)
    ]


def away_views(run: FinishedRun, source: Source, most: int) -> list[UnseenView]:
    """Return the source's test views at their true poses, moved to the world by `aligned_poses` of the path."""
    away, truth = source.test_views(), source.truth()
    poses = None if away is None else away.truth()
    if away is None or poses is None or truth is None or not run.valid.any():
        return []
    path = run.path.at(run.valid)
    matched, true_rows = associate(path.timestamps_s, truth.timestamps_s)
    if not len(matched):
        return []
    T_estimate_truth = aligned_poses(truth.T_world_camera[true_rows], path.T_world_camera[matched])
    found = list[UnseenView]()
    for i in evenly_spread(range(len(away)), most):
        rows, at = associate(np.array([away.timestamp_s(i)]), poses.timestamps_s)
        if len(rows):
            found.append(_unseen_view(run.config, away, i, T_estimate_truth @ poses.T_world_camera[at[0]], 0))
    return found


def _unseen_view(config: Config, source: Source, index: int, T_world_camera: Matrix, submap: int) -> UnseenView:
    """Read a view at working size, with exact depth if the source knows it."""
    settings = config.input
    frame, exact = working_frame(source, settings, index), source.exact_depth_of(index)
    if exact is not None:
        width, height = frame.camera.width + 2 * settings.crop_px, frame.camera.height + 2 * settings.crop_px
        inner = np.s_[settings.crop_px : height - settings.crop_px, settings.crop_px : width - settings.crop_px]
        depth = resized_depth(exact, width, height)[inner]
        keep = (depth >= settings.min_depth_m) & (depth <= settings.max_depth_m)
        depth = np.ascontiguousarray(np.where(keep, depth, np.float32(0.0)))
        frame = Frame(frame.index, frame.timestamp_s, frame.color, depth, frame.camera)
    return UnseenView(frame, T_world_camera, submap, exact is not None)
