"""Score the path of a run on the sets of frames that published systems use: keyframes, and all frames."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.evaluation.frame_states import final_positions
from sigmasplat.io.frames import RunFrames
from sigmasplat.io.runs import RunFolder
from sigmasplat.metrics.trajectory import absolute_error, associate
from sigmasplat.model.trajectory import Trajectory


def score_frame_sets(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any]:
    """Return the ATE on believed keyframes, and on all frames that have a position in the world.

    All frames are the believed ones, and lost ones at their last guess (checkpoint). Frames apart have no position in
    the world. Each set has its own alignment. None without a truth, or without a frame that has a true position.
    """
    if truth is None:
        return {"ate_keyframes": None, "ate_all_frames": None}
    times_s = np.array([record["timestamp_s"] for record in frames.log])
    keyframes = frames.believed & np.array([bool(record["is_keyframe"]) for record in frames.log], np.bool_)
    positions = final_positions(run, frames)
    return {
        "ate_keyframes": _error(times_s[keyframes], positions[keyframes], truth),
        "ate_all_frames": _error(times_s, positions, truth),
    }


def _error(times_s: NDArray[np.float64], positions: NDArray[np.float64], truth: Trajectory) -> dict[str, Any] | None:
    rows, truth_rows = associate(times_s, truth.timestamps_s)
    known = np.isfinite(positions[rows]).all(1)
    if not known.any():
        return None
    return asdict(absolute_error(positions[rows][known], truth.T_world_camera[truth_rows][known, :3, 3]))
