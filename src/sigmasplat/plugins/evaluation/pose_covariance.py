"""Score the covariance of a run's poses against the truth: hops between keyframes, windows, and from the start."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.plugins.evaluation.metrics.pose_covariance import score_covariances
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.types import Matrix

WINDOW_FRAMES = 50
MOTIONS = {"hops": "keyframe to keyframe", "windows": f"{WINDOW_FRAMES} frames", "from_start": "from the start"}
"""Kinds of motions, and their names in tables."""


def score_pose_covariance(run: RunFolder, frames: RunFrames, truth: Trajectory | None) -> dict[str, Any] | None:
    """Score the motions of `score_motions` between valid frames of a run.

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
    """Score the motions of `score_motions` between the valid frames with a true pose.

    path: poses of the valid frames; rows: their numbers [B]; keyframes: the numbers of all keyframes.
    """
    matched, true_rows = associate(path.timestamps_s, truth.timestamps_s)
    true = dict(zip(rows[matched].tolist(), truth.T_world_camera[true_rows], strict=True))
    return score_motions(errors, true, [frame for frame in keyframes if frame in true])


def score_motions(
    errors: PathCovariance, T_world_camera: Mapping[int, Matrix], keyframes: Sequence[int]
) -> dict[str, Any]:
    """Score motions from each keyframe to the next, over 50 frames, and from the first frame (`CovarianceScore`).

    T_world_camera: true poses [4, 4] of valid frames, in order; keyframes: the keyframes among them. Motions do not
    depend on the world frame, so no alignment is needed.
    """
    known = list(T_world_camera)
    pairs = {
        "hops": list(pairwise(keyframes)),
        "windows": [(frame, frame + WINDOW_FRAMES) for frame in known if frame + WINDOW_FRAMES in T_world_camera],
        "from_start": [(known[0], frame) for frame in known[1:]],
    }

    def scored(between: Sequence[tuple[int, int]]) -> dict[str, Any] | None:
        estimate, true = (
            np.array([se3.inverse(poses[a]) @ poses[b] for a, b in between]).reshape(-1, 4, 4)
            for poses in (errors.T_world_camera, T_world_camera)
        )
        covariance = np.array([errors.between(a, b) for a, b in between]).reshape(-1, 6, 6)
        score = score_covariances(estimate, true, covariance)
        return None if score is None else asdict(score)

    return {"window_frames": WINDOW_FRAMES} | {name: scored(between) for name, between in pairs.items()}
