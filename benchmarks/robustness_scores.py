"""Score runs on disturbed recordings against the true path, frame by frame: lost, right, or wrong in silence."""

import json
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from disturbances import Plan
from disturbed_recordings import FRAMES_PER_SECOND
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.evaluation.metrics import trajectory as failures
from sigmasplat.plugins.evaluation.metrics.trajectory import OFF_M, SILENT_M, align_rigid

ANCHOR_FRAMES, ANCHOR_M = 20, 0.05
"""Without an event, this number of first frames fixes the world; frames further off than this do not count."""
KNOWN_M, KNOWN_DEG = 0.5, 25.0
"""A view is known if a frame from before the event is this near and looks in this direction."""
Truth = NDArray[np.float64]
"""T_world_camera [1 or 2, N, 4, 4]: the true poses of the colour, and of the depth if it shows other frames."""


@dataclass(frozen=True, eq=False)
class RunPath:
    """The frames of a run: poses when they were tracked and at the end, T_world_camera [N, 4, 4], nan without a pose.

    valid: in trajectory.txt and not lost; p_off [N]: nan if the log does not have it; log: the lines of log.jsonl,
    None for a frame without one.
    """

    tracked: NDArray[np.float64]
    final: NDArray[np.float64]
    lost: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    p_off: NDArray[np.float64]
    log: list[dict[str, Any] | None]


def read_run(folder: Path, frames: int) -> RunPath:
    """Read the run folder of any version. Raises OSError, ValueError or SigmaSplatError if files are missing."""
    log: list[dict[str, Any] | None] = [None] * frames
    for line in (folder / "log.jsonl").read_text(encoding="utf-8").splitlines():
        values = json.loads(line)
        log[values["index"]] = values
    tracked, final = (np.full((frames, 4, 4), np.nan) for _ in range(2))
    lost, p_off = np.ones(frames, bool), np.full(frames, np.nan)
    for index, values in enumerate(log):
        if values is not None:
            lost[index] = values["lost"]
            p_off[index] = np.nan if values.get("p_off") is None else values["p_off"]
            if values["T_world_camera"] is not None:
                tracked[index] = values["T_world_camera"]
    path = read_poses(folder / "trajectory.txt")
    rows = np.rint(path.timestamps_s * FRAMES_PER_SECOND).astype(int)
    final[rows] = path.T_world_camera
    valid = np.isfinite(final[:, 0, 0]) & ~lost  # a component that joined the world later is valid at the end
    return RunPath(tracked, final, lost, valid, p_off, log)


def world_of_truth(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_truth_estimate [4, 4] from poses T_world_camera [N, 4, 4] of the first frames, before they can be wrong.

    The first pose is exact by definition. The others average out noise in the truth if they agree with it within 5 cm;
    rotations come from rotations, because positions on a line leave one angle open.
    """
    first = truth[0] @ se3.inverse(estimate[0])
    off_m = np.linalg.norm((first @ estimate)[:, :3, 3] - truth[:, :3, 3], axis=1)
    used = off_m < ANCHOR_M
    u, _, vt = np.linalg.svd((truth[used, :3, :3] @ estimate[used, :3, :3].transpose(0, 2, 1)).sum(0))
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    T[:3, 3] = truth[used, :3, 3].mean(0) - T[:3, :3] @ estimate[used, :3, 3].mean(0)
    return T


def errors_m(poses: NDArray[np.float64], run: RunPath, truth: Truth, event: int) -> NDArray[np.float64]:
    """Return how far the positions of poses [N, 4, 4] are from the truth, m [N]; nan without a pose.

    The nearer one counts where colour and depth have different true poses. The world is fixed by the valid frames
    before frame `event`, the first 20 if that is 0.
    """
    early = np.flatnonzero(run.valid[: event or ANCHOR_FRAMES])
    if not len(early):
        return np.full(len(poses), np.nan)
    T = world_of_truth(poses[early], truth[0, early])
    off: NDArray[np.float64] = np.linalg.norm((T @ poses)[:, :3, 3] - truth[:, :, :3, 3], axis=2).min(0)
    return off


def ate_m(run: RunPath, truth: Truth) -> float | None:
    """Return the RMSE of the valid positions after the usual rigid alignment, m; None with fewer than 3."""
    positions = run.final[run.valid, :3, 3]
    if len(positions) < 3:
        return None
    true = truth[0, run.valid, :3, 3]
    T = align_rigid(positions, true)
    return float(np.sqrt(((positions @ T[:3, :3].T + T[:3, 3] - true) ** 2).sum(1).mean()))


def known_views(truth: Truth, begin: int, end: int) -> NDArray[np.bool_]:
    """Return for each frame [N] whether it is after the event and sees what a frame before the event has seen."""
    centre, axis = truth[0, :, :3, 3], truth[0, :, :3, 2]
    near = np.linalg.norm(centre[:, None] - centre[None, :begin], axis=2) < KNOWN_M
    along = axis @ axis[:begin].T > np.cos(np.radians(KNOWN_DEG))
    known: NDArray[np.bool_] = (near & along).any(1) & (np.arange(len(centre)) >= end)
    return known


def score(run: RunPath, truth: Truth, planned: Plan) -> dict[str, Any]:
    """Return the figures of a run.

    Frames off by more than 10 cm are wrong; those that are valid are silent failures, and `silent_in_a_row` is the
    longest time, in frames, until one is declared. `recovery` is the number of frames from the end of the event to the
    first right one, `recovery_known` from the first known view, which comes `known` frames after the end; None if
    there is none.
    """
    off = errors_m(run.final, run, truth, planned.begin)
    wrong = run.valid & ~(off <= SILENT_M)
    right = run.valid & ~wrong
    outside = np.ones(len(off), bool)
    outside[planned.begin : planned.end] = False
    known = _first(known_views(truth, planned.begin, planned.end), planned.end) if planned.end else None
    return {
        "frames": len(off),
        "lost": int(run.lost.sum()),
        "believed": int(run.valid.sum()),
        "silent": int(wrong.sum()),
        "silent_in_a_row": max((len([*row]) for is_wrong, row in groupby(wrong) if is_wrong), default=0),
        "ate_m": ate_m(run, truth),
        "outside": int(outside.sum()),
        "missed_outside": int((outside & ~run.valid).sum()),
        "event": [planned.begin, planned.end] if planned.end else None,
        "recovery": _first(right, planned.end) if planned.end else None,
        "known": known,
        "recovery_known": None if known is None else _first(right, planned.end + known),
    }


def _first(chosen: NDArray[np.bool_], begin: int) -> int | None:
    """Return the number of frames from `begin` to the first chosen one; None without one."""
    rows = np.flatnonzero(chosen[begin:])
    return int(rows[0]) if len(rows) else None


def pairs(run: RunPath, truth: Truth, planned: Plan) -> list[tuple[float, bool]]:
    """Return (p_off, whether the pose is off by more than 5 cm) of every frame with a pose, lost ones included.

    The pose is the one at the time of tracking, as in log.jsonl. The list is empty if the log has no p_off.
    """
    off = errors_m(run.tracked, run, truth, planned.begin)
    known = np.flatnonzero(np.isfinite(off) & np.isfinite(run.p_off))
    return [(float(run.p_off[i]), bool(off[i] > OFF_M)) for i in known]


def arrays(run: RunPath, truth: Truth, planned: Plan) -> dict[str, NDArray[Any]]:
    """Return all tracking values of the log by name, with the true errors, an array [N] each; nan for missing ones."""
    names = sorted({name for line in run.log if line for name in line["tracking"]})
    values = {name: [_number(line["tracking"].get(name) if line else None) for line in run.log] for name in names}
    return {
        **{f"tracking_{name}": np.array(column, float) for name, column in values.items()},
        "error_tracked_m": errors_m(run.tracked, run, truth, planned.begin),
        "error_final_m": errors_m(run.final, run, truth, planned.begin),
        "lost": run.lost,
        "believed": run.valid,
        "p_off": run.p_off,
        "is_keyframe": np.array([bool(line and line["is_keyframe"]) for line in run.log]),
        "T_tracked": run.tracked,
        "T_final": run.final,
        "T_true": truth[0],
        "event": np.array([planned.begin, planned.end]),
    }


def _number(value: Any) -> float:
    """Return a logged value as a number; nan for null and for text."""
    return float(value) if isinstance(value, int | float) else np.nan


# ---- the probability of failure ----


def auroc(p: NDArray[np.float64], off: NDArray[np.bool_]) -> float | None:
    """Return `metrics.trajectory.auroc`; None, which JSON can hold, if all frames are off or none is."""
    area = failures.auroc(p, off)
    return area if np.isfinite(area) else None


def calibration(p: NDArray[np.float64], off: NDArray[np.bool_]) -> list[dict[str, float]]:
    """Return for each tenth of the range of p that has frames: their number, mean p, and the share that is off."""
    bins = failures.calibration(p, off)
    return [{"frames": b["frames"], "mean_p": b["predicted"], "off": b["observed"]} for b in bins]


def probability_scores(all_pairs: list[tuple[float, bool]]) -> dict[str, Any] | None:
    """Return AUROC, Brier score and calibration table of pairs (p_off, off); None without pairs."""
    if not all_pairs:
        return None
    p, off = np.array([pair[0] for pair in all_pairs]), np.array([pair[1] for pair in all_pairs], bool)
    return {
        "frames": len(p),
        "off": int(off.sum()),
        "auroc": auroc(p, off),
        "brier": failures.brier(p, off),
        "calibration": calibration(p, off),
    }
