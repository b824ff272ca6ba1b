"""Score the path of a run on the sets of frames that published systems use: keyframes, and all frames."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import APART, LOST, RELOCALISED, PathCovariance, RunFolder, RunFrames, Trajectory, se3
from sigmasplat.plugins.evaluation.metrics import trajectory
from sigmasplat.plugins.evaluation.metrics.trajectory import associate


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
    scale, _ = trajectory.align_similarity(path.T_world_camera[rows, :3, 3], truth.T_world_camera[truth_rows, :3, 3])
    return scale if scale > 0 else None


def in_units_of_run(truth: Trajectory, scale: float | None) -> Trajectory:
    """Return the truth in the units of a run whose path times `scale` is in metres."""
    if scale is None:
        return truth
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] /= scale
    return Trajectory(truth.timestamps_s, poses, truth.error_rms and (truth.error_rms[0] / scale, truth.error_rms[1]))


def in_metres(scores: dict[str, Any], scale: float | None) -> dict[str, Any]:
    """Return scores of the path, in the units of the run, with all lengths (`…_m`) in metres of the truth."""
    if scale is None:
        return scores
    return {
        name: {key: value * scale if key.endswith("_m") else value for key, value in found.items()} if found else found
        for name, found in scores.items()
    }


def _error(times_s: NDArray[np.float64], positions: NDArray[np.float64], truth: Trajectory) -> dict[str, Any] | None:
    rows, truth_rows = associate(times_s, truth.timestamps_s)
    known = np.isfinite(positions[rows]).all(1)
    if not known.any():
        return None
    return asdict(trajectory.absolute_error(positions[rows][known], truth.T_world_camera[truth_rows][known, :3, 3]))


def score_states(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any]:
    """Return the numbers of frames by state, the components apart, and `failures`, which is None without a truth."""
    counts: dict[str, Any] = {"believed": len(frames.rows), "believed_share": len(frames.rows) / max(len(frames), 1)}
    for state in (LOST, RELOCALISED, APART):
        found = frames.indices(state)
        counts |= {state: len(found), f"{state}_frames": found}
    return counts | {"components": _components(run), "failures": _failures(run, frames, truth)}


def _components(run: RunFolder) -> list[dict[str, Any]]:
    """Describe the components apart: number, frames, and time of the first and the last frame."""
    paths = {number: run.read_component(number).trajectory for number in run.component_numbers()}
    return [
        {"number": number, "frames": len(path), "start_s": path.timestamps_s[0], "end_s": path.timestamps_s[-1]}
        for number, path in paths.items()
    ]


def _failures(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any] | None:
    """Score the valid and the lost frames of the world; the alignment is that of the ATE, from valid frames."""
    if truth is None:
        return None
    times_s = np.array([record["timestamp_s"] for record in frames.log])
    positions = final_positions(run, frames)
    rows, truth_rows = associate(times_s, truth.timestamps_s)
    true_positions = np.full_like(positions, np.nan)
    true_positions[rows] = truth.T_world_camera[truth_rows, :3, 3]
    fitted = frames.valid & np.isfinite(true_positions).all(1)
    T = trajectory.align_rigid(positions[fitted], true_positions[fitted])
    error_m = np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - true_positions, axis=1)
    scores = trajectory.score_failures(error_m, frames.p_off, frames.valid)
    silent_rows = scores.pop("silent_rows")
    return scores | {"silent_frames": [frames.log[row]["index"] for row in silent_rows]}


def final_positions(run: RunFolder, frames: RunFrames) -> NDArray[np.float64]:
    """Return the final positions [F, 3], m, of valid frames and, from the checkpoint, of lost ones; else nan."""
    positions = np.full((len(frames), 3), np.nan)
    lost = np.flatnonzero((np.array(frames.states) == LOST) & ~frames.outside())
    if len(lost) and (run.path / "checkpoint.safetensors").is_file():
        poses = run.read_checkpoint()[0].get("T_world_camera")
        if poses is not None:
            lost = lost[lost < len(poses)]
            positions[lost] = poses.numpy()[lost, :3, 3]
    positions[frames.rows] = frames.path.T_world_camera[:, :3, 3]
    return positions


WINDOW_FRAMES = 50
MOTIONS = {"hops": "keyframe to keyframe", "windows": f"{WINDOW_FRAMES} frames", "from_start": "from the start"}
"""Kinds of motions, and their names in tables."""
WITH_TRUTH = ("coverage_90", "position_coverage_90", "position_k")
"""Scores that are also given with the truth's own error, as `…_with_truth`."""


def score_pose_covariance(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any] | None:
    """Score the motions of `score_path_covariance` between valid frames of a run.

    Returns None without a truth, or if the run did not record the errors of its path.
    """
    if truth is None or not len(frames.rows) or not (run.path / "checkpoint.safetensors").is_file():
        return None
    errors = PathCovariance.of(run.read_checkpoint()[0])
    if errors is None or len(errors) <= frames.rows[-1]:
        return None
    keyframes = [row for row, record in enumerate(frames.log) if record["is_keyframe"]]
    return score_path_covariance(errors, frames.path, frames.rows, keyframes, truth)


def score_path_covariance(
    errors: PathCovariance, path: Trajectory, rows: NDArray[np.intp], keyframes: Iterable[int], truth: Trajectory
) -> dict[str, Any]:
    """Score motions from each keyframe to the next, over 50 frames, and from the first frame (`score_covariances`).

    path: poses of the valid frames; rows: their numbers [B]; keyframes: the numbers of all keyframes. Only frames with
    a true pose count. Motions do not depend on the world frame, so no alignment is needed. The truth's own error
    (`error_rms`) counts as an error of the poses; where it is known, scores with it in the covariance stand beside.
    """
    matched, true_rows = associate(path.timestamps_s, truth.timestamps_s)
    T_world_camera = dict(zip(rows[matched].tolist(), truth.T_world_camera[true_rows], strict=True))
    known, own = list(T_world_camera), np.diag(np.repeat(np.square(truth.error_rms or (0.0, 0.0)) / 3.0, 3))
    pairs = {
        "hops": list(pairwise(frame for frame in keyframes if frame in T_world_camera)),
        "windows": [(frame, frame + WINDOW_FRAMES) for frame in known if frame + WINDOW_FRAMES in T_world_camera],
        "from_start": [(known[0], frame) for frame in known[1:]],
    }

    def scored(between: Sequence[tuple[int, int]]) -> dict[str, Any] | None:
        estimate, true = (
            np.array([se3.inverse(poses[a]) @ poses[b] for a, b in between]).reshape(-1, 4, 4)
            for poses in (errors.T_world_camera, T_world_camera)
        )
        covariance = np.array([errors.between(a, b) for a, b in between]).reshape(-1, 6, 6)
        score, A = trajectory.score_covariances(estimate, true, covariance), se3.adjoint(estimate)
        truths = trajectory.score_covariances(estimate, true, covariance + own + A @ own @ np.swapaxes(A, 1, 2))
        if score is None or truths is None:
            return None
        return score | ({f"{name}_with_truth": truths[name] for name in WITH_TRUTH} if own.any() else {})

    std_m, std_deg = (truth.error_rms[0], float(np.rad2deg(truth.error_rms[1]))) if truth.error_rms else (None, None)
    facts = {"window_frames": WINDOW_FRAMES, "truth_error_m": std_m, "truth_error_deg": std_deg}
    return facts | {name: scored(between) for name, between in pairs.items()}
