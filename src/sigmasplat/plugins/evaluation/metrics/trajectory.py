"""Score a trajectory against the truth: absolute error (ATE) after a rigid alignment, and relative error (RPE)."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri

from sigmasplat.api import Matrix, SourceError, Trajectory, se3

Rows = NDArray[np.intp]
MAX_DIFFERENCE_S = 0.02
"""Largest difference of two timestamps of one pose."""


@dataclass(frozen=True)
class AbsoluteError:
    """Distances between aligned positions, metres, over `pairs` poses."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    pairs: int


def align_rigid(estimate: Matrix, truth: Matrix) -> Matrix:
    """Fit T_truth_estimate [4, 4] that maps positions `estimate` [N, 3] to `truth` [N, 3], by least squares.

    Closed form without scale: the rotation comes from the SVD of the cross-covariance (Umeyama 1991, eq. 40–42, c = 1).
    """
    centre_estimate, centre_truth = estimate.mean(0), truth.mean(0)
    covariance = (truth - centre_truth).T @ (estimate - centre_estimate)
    u, _, vt = np.linalg.svd(covariance)
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = centre_truth - R @ centre_estimate
    return T


def align_similarity(estimate: Matrix, truth: Matrix) -> tuple[float, Matrix]:
    """Fit the scale c and T [4, 4] that map positions `estimate` [N, 3], times c, to `truth`, by least squares (Umeyama
    1991, eq. 40–42): for paths whose scale is arbitrary. c is 1 if the estimate does not move."""
    T = align_rigid(estimate, truth)
    centred = estimate - estimate.mean(0)
    square = float((centred**2).sum())
    c = float(((centred @ T[:3, :3].T) * (truth - truth.mean(0))).sum()) / square if square > 0 else 1.0
    T[:3, 3] = truth.mean(0) - c * T[:3, :3] @ estimate.mean(0)
    return c, T


def truth_in_estimate(times_s: Matrix, estimate: Matrix, truth: Trajectory) -> Matrix:
    """Return T_estimate_truth [4, 4], the rigid alignment of the ATE: true positions to estimated ones [N, 3], m."""
    rows, truth_rows = associate(times_s, truth.timestamps_s)
    return align_rigid(truth.T_world_camera[truth_rows, :3, 3], estimate[rows])


def associate(times_a_s: Matrix, times_b_s: Matrix) -> tuple[Rows, Rows]:
    """Pair timestamps that are mutual nearest neighbours and differ by at most `MAX_DIFFERENCE_S`: rows of a and of b.

    Pairs are one-to-one. If a low-rate truth paired one pose with two frames, the RPE would see no motion there.
    """
    if not len(times_a_s) or not len(times_b_s):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    nearest_b = np.asarray(cKDTree(times_b_s[:, None]).query(times_a_s[:, None])[1], np.intp)
    nearest_a = np.asarray(cKDTree(times_a_s[:, None]).query(times_b_s[:, None])[1], np.intp)
    rows_a = np.arange(len(times_a_s))
    mutual = nearest_a[nearest_b] == rows_a
    close = np.abs(times_a_s - times_b_s[nearest_b]) <= MAX_DIFFERENCE_S
    chosen = rows_a[mutual & close]
    return chosen, nearest_b[chosen]


def pair_poses(estimate: Trajectory, truth: Trajectory) -> tuple[Matrix, Matrix]:
    """Return T_world_camera of both trajectories [M, 4, 4] at shared timestamps, in the order of the estimate.

    Raises SourceError if no timestamps agree within `MAX_DIFFERENCE_S`.
    """
    rows, truth_rows = associate(estimate.timestamps_s, truth.timestamps_s)
    if not len(rows):
        raise SourceError(
            f"estimate and truth share no timestamps within {MAX_DIFFERENCE_S} s: {_span(estimate)} against "
            f"{_span(truth)}; are both in seconds, from one clock and one recording?"
        )
    return estimate.T_world_camera[rows], truth.T_world_camera[truth_rows]


def _span(path: Trajectory) -> str:
    if not len(path):
        return "no poses"
    return f"{path.timestamps_s.min():.3f} … {path.timestamps_s.max():.3f} s ({len(path)} poses)"


def ate(estimate: Trajectory, truth: Trajectory) -> AbsoluteError:
    """Measure the absolute trajectory error: position errors after `align_rigid` (Sturm et al. 2012, eq. 3).

    Raises SourceError if no timestamps match.
    """
    ours, theirs = pair_poses(estimate, truth)
    return absolute_error(ours[:, :3, 3], theirs[:, :3, 3])


def absolute_error(estimate: Matrix, truth: Matrix) -> AbsoluteError:
    """Measure the distances between positions [N, 3], N ≥ 1, after `align_rigid`."""
    T = align_rigid(estimate, truth)
    distance = np.linalg.norm(estimate @ T[:3, :3].T + T[:3, 3] - truth, axis=1)
    return AbsoluteError(
        _root_mean_square(distance), float(distance.mean()), float(np.median(distance)), float(distance.max()),
        len(distance),
    )  # fmt: skip


def rpe(estimate: Trajectory, truth: Trajectory, delta_frames: int = 1) -> dict[str, float]:
    """Measure the relative pose error over `delta_frames` paired frames (Sturm et al. 2012, eq. 1), without alignment:
    root mean square over `pairs` motions, metres and degrees.

    With fewer than delta_frames + 1 pairs the errors are nan and pairs = 0. Raises SourceError if no timestamps match.
    """
    ours, theirs = pair_poses(estimate, truth)
    motion_ours = se3.inverse(ours[:-delta_frames]) @ ours[delta_frames:]
    motion_theirs = se3.inverse(theirs[:-delta_frames]) @ theirs[delta_frames:]
    error = se3.inverse(motion_theirs) @ motion_ours
    angles = np.array([se3.rotation_angle(E[:3, :3]) for E in error])
    shift = np.linalg.norm(error[:, :3, 3], axis=1)
    return {
        "translation_rmse_m": _root_mean_square(shift),
        "rotation_rmse_deg": float(np.degrees(_root_mean_square(angles))),
        "pairs": len(error), "delta_frames": delta_frames,
    }  # fmt: skip


def _root_mean_square(values: Matrix) -> float:
    """Return √mean(x²); nan without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def score_path(
    path: Trajectory, odometry: Trajectory | None, truth: Trajectory | None
) -> tuple[dict[str, Any], SourceError | None]:
    """Return ATE and RPE over all poses, and the ATE of the path without loop closures (`odometry`) if given.

    All scores are None without a truth. If the truth shares no timestamps with the path, the scores are None and the
    error is returned too.
    """
    unknown: dict[str, Any] = {"ate": None, "rpe": None, "ate_odometry": None}
    if truth is None:
        return unknown, None
    try:
        found = {"ate": asdict(ate(path, truth)), "rpe": rpe(path, truth)}
        return unknown | found | ({"ate_odometry": asdict(ate(odometry, truth))} if odometry else {}), None
    except SourceError as problem:
        return unknown, problem


OFF_M, SILENT_M, BINS = 0.05, 0.10, 10
"""`p_off` is the probability that a pose is off by more than the first; a valid pose that is off by more than the
second is a silent failure."""

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]


def score_failures(error_m: Values, p_off: Values, valid: Mask) -> dict[str, Any]:
    """Score the frames of a run.

    error_m [F]: distance from the true position after the alignment of the ATE, nan if it is not known; p_off [F]: the
    predicted probability that it is above 5 cm, nan if it is not known; valid [F]: whether the pose is valid.

    `silent_rows` are the rows of the valid frames that are off by more than 10 cm. `auroc` and `brier` judge p_off
    on all frames with both values; both are nan if there is no such frame, and auroc also if all or none are off.
    """
    silent = valid & (error_m > SILENT_M)
    known = np.isfinite(error_m) & np.isfinite(p_off)
    off, p = error_m[known] > OFF_M, p_off[known]
    return {
        "frames": int(np.isfinite(error_m).sum()), "off": int((error_m > OFF_M).sum()), "silent": int(silent.sum()),
        "silent_rows": np.flatnonzero(silent).tolist(), "auroc": auroc(p, off), "brier": brier(p, off),
        "calibration": calibration(p, off),
    }  # fmt: skip


def auroc(p: Values, off: Mask) -> float:
    """Return the area under the ROC curve: how often p is higher for a frame that is off than for one that is not.

    Ties count one half. ½: p is random; nan if all or none are off.
    """
    others, of_off = np.sort(p[~off]), p[off]
    lower = np.searchsorted(others, of_off, "left") + np.searchsorted(others, of_off, "right")
    return float(lower.sum() / (2.0 * len(others) * len(of_off))) if len(others) * len(of_off) else float("nan")


def brier(p: Values, off: Mask) -> float:
    """Return the mean of (p − off)² (Brier 1950); 0 is perfect, nan without values."""
    return float(np.mean((p - off) ** 2)) if len(p) else float("nan")


def calibration(p: Values, off: Mask, bins: int = BINS) -> list[dict[str, float]]:
    """Return the mean p and the share of frames that are off, for each non-empty bin of p of equal width."""
    bin_of = np.minimum((p * bins).astype(int), bins - 1)
    return [
        {"predicted": float(p[at].mean()), "observed": float(off[at].mean()), "frames": int(at.sum())}
        for at in (bin_of == number for number in np.unique(bin_of))
    ]


LEVEL = 0.9
"""The coverage that is measured."""


def score_covariances(T_estimate: Matrix, T_true: Matrix, covariance: Matrix) -> dict[str, float] | None:
    """Score how honest covariances [N, 6, 6] of the left twists (m, rad) of estimated poses or motions [N, 4, 4] are,
    given the true ones; None without poses.

    NEES is eᵀ Σ⁻¹ e. If Σ is right, its mean is the number of components, 6 or 3, and `coverage_90` is 0.9: the share
    of errors inside the ellipsoid that should hold 90 %. `position_`: of the position alone. position_k: the median
    NEES of the position divided by its expected value 2.37, as in `smfeval`: the variances are k times too small.
    """
    if not len(T_estimate):
        return None
    twists = se3.log_stack(T_true @ se3.inverse(T_estimate))
    J = se3.displacement(T_estimate)[:, :3]
    shifts = T_true[:, :3, 3] - T_estimate[:, :3, 3]
    full, position = nees(twists, covariance), nees(shifts, J @ covariance @ np.swapaxes(J, 1, 2))
    median = float(np.median(position))
    return {
        "count": len(full), "nees_mean": float(full.mean()), "nees_median": float(np.median(full)),
        "coverage_90": float((full <= chdtri(6, 1.0 - LEVEL)).mean()), "position_nees_median": median,
        "position_k": median / float(chdtri(3, 0.5)),
        "position_coverage_90": float((position <= chdtri(3, 1.0 - LEVEL)).mean()),
    }  # fmt: skip


def nees(errors: Matrix, covariance: Matrix) -> Matrix:
    """Return eᵀ Σ⁻¹ e [N] of errors [N, D] with covariances [N, D, D]."""
    return np.asarray((errors * np.linalg.solve(covariance, errors[:, :, None])[..., 0]).sum(1))
