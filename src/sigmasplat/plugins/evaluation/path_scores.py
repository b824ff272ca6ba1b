"""Score the path of a run on the sets of frames that published systems use: keyframes, and all frames."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.evaluation.frame_states import final_positions
from sigmasplat.plugins.evaluation.metrics.trajectory import absolute_error, align_similarity, associate
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import RunFolder


def score_frame_sets(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any]:
    """Return the ATE on valid keyframes, and on all frames that have a position in the world.

    All frames are the valid ones, and lost ones at their last guess (checkpoint). Frames apart have no position in
    the world. Each set has its own alignment. None without a truth, or without a frame that has a true position.
    """
    if truth is None:
        return {"ate_keyframes": None, "ate_all_frames": None}
    times_s = np.array([record["timestamp_s"] for record in frames.log])
    keyframes = frames.valid & np.array([bool(record["is_keyframe"]) for record in frames.log], np.bool_)
    positions = final_positions(run, frames)
    return {
        "ate_keyframes": _error(times_s[keyframes], positions[keyframes], truth),
        "ate_all_frames": _error(times_s, positions, truth),
    }


def arbitrary_scale(run: RunFolder, path: Trajectory, truth: Trajectory | None) -> float | None:
    """Return the factor that brings a path to the scale of the truth, if a network predicted the run's depth; None if
    the scale is that of a sensor or of given poses, or cannot be found."""
    if truth is None or not run.facts().get("predicted_depth") or run.config().input.poses_scale_depth:
        return None
    rows, truth_rows = associate(path.timestamps_s, truth.timestamps_s)
    if not len(rows):
        return None
    scale, _ = align_similarity(path.T_world_camera[rows, :3, 3], truth.T_world_camera[truth_rows, :3, 3])
    return scale if scale > 0 else None


def in_units_of_run(truth: Trajectory, scale: float | None) -> Trajectory:
    """Return the truth in the units of a run whose path times `scale` is in metres."""
    if scale is None:
        return truth
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] /= scale
    return Trajectory(truth.timestamps_s, poses)


def in_metres(scores: dict[str, Any], scale: float | None) -> dict[str, Any]:
    """Return scores of the path, in the units of the run, with all lengths (`…_m`) in metres of the truth."""
    if scale is None:
        return scores
    return {name: _in_metres(found, scale) for name, found in scores.items()}


def _in_metres(found: Any, scale: float) -> Any:
    if not isinstance(found, dict):
        return found
    return {key: value * scale if key.endswith("_m") else value for key, value in found.items()}


def _error(times_s: NDArray[np.float64], positions: NDArray[np.float64], truth: Trajectory) -> dict[str, Any] | None:
    rows, truth_rows = associate(times_s, truth.timestamps_s)
    known = np.isfinite(positions[rows]).all(1)
    if not known.any():
        return None
    return asdict(absolute_error(positions[rows][known], truth.T_world_camera[truth_rows][known, :3, 3]))
