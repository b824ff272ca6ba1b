"""Count the states of a run's frames, and score how reliable its declared states and probabilities are."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.component import APART, LOST, RELOCALISED
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.evaluation.metrics.failures import score_failures
from sigmasplat.plugins.evaluation.metrics.trajectory import align_rigid, associate
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import RunFolder


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
    T = align_rigid(positions[fitted], true_positions[fitted])
    error_m = np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - true_positions, axis=1)
    scores = score_failures(error_m, frames.p_off, frames.valid)
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
