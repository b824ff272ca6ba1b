"""The frames of a run at its end: log and trajectory combined, scores of the declared states and probabilities."""

import numpy as np
import pytest

from sigmasplat.data.trajectory import Trajectory, outside_world, submaps_outside
from sigmasplat.plugins.evaluation.metrics.trajectory import auroc, brier, calibration, score_failures
from sigmasplat.run_folder.frames import RunFrames


def path(*times_s: float) -> Trajectory:
    """Return poses whose x position is their number in the path."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 0, 3] = np.arange(len(times_s))
    return Trajectory(np.array(times_s), poses)


def log_of(states: str, times_s: list[float] | None = None) -> list[dict[str, object]]:
    """Return a log of frames: t(racked), r(elocalised), l(ost), a(part)."""
    names = {"t": "tracked", "r": "relocalised", "l": "lost", "a": "apart"}
    times_s = [float(i) for i in range(len(states))] if times_s is None else times_s
    return [
        {"index": 10 + i, "timestamp_s": t, "lost": s == "l", "state": names[s], "submap": i // 2}
        for i, (s, t) in enumerate(zip(states, times_s, strict=True))
    ]


def test_the_states_at_the_end_follow_from_log_and_trajectory() -> None:
    frames = RunFrames.of(log_of("ttlraalatt"), path(0, 1, 3, 8, 9))
    assert frames.states == ("tracked", "tracked", "lost", "relocalised", "apart", "apart", "lost", "apart",
                             "tracked", "tracked")  # fmt: skip
    assert frames.rows.tolist() == [0, 1, 3, 8, 9] and frames.indices("lost") == [12, 16]
    assert frames.outside().tolist() == [False] * 4 + [True] * 4 + [False] * 2
    assert frames.submaps_outside() == {2, 3}
    assert [(r["row"], r["T_world_camera"][0, 3]) for r in frames.posed_log()] == [
        (0, 0),
        (1, 1),
        (3, 2),
        (8, 3),
        (9, 4),
    ]


def test_a_frame_that_joined_later_is_tracked_and_one_that_was_separated_is_apart() -> None:
    frames = RunFrames.of(log_of("taat"), path(0, 1, 2))
    assert frames.states == ("tracked", "tracked", "tracked", "apart")


def test_equal_and_unsorted_times_are_told_apart_by_their_order() -> None:
    frames = RunFrames.of(log_of("tlttt", [0.0, 5.0, 5.0, 5.0, 2.0]), path(0, 5, 5, 2))
    assert frames.rows.tolist() == [0, 2, 3, 4] and frames.path.T_world_camera[:, 0, 3].tolist() == [0, 1, 2, 3]


def test_frames_lost_after_a_frame_apart_are_outside_too() -> None:
    states = np.array(["lost", "tracked", "apart", "lost", "lost", "relocalised", "lost"])
    assert outside_world(states).tolist() == [False, False, True, True, True, False, False]
    assert submaps_outside(states, np.array([0, 0, 1, 1, 1, 2, 2])) == {1}


def test_auroc_counts_pairs_in_the_right_order() -> None:
    rng = np.random.default_rng(0)
    p, off = rng.integers(0, 8, 60) / 8.0, rng.random(60) < 0.3
    pairs = [(a > b) + 0.5 * (a == b) for a in p[off] for b in p[~off]]
    assert auroc(p, off) == pytest.approx(np.mean(pairs))
    assert auroc(off.astype(float), off) == 1.0
    assert np.isnan(auroc(p, np.zeros(60, bool))) and np.isnan(brier(p[:0], off[:0]))


def test_calibration_compares_predicted_and_observed_shares() -> None:
    p = np.array([0.0, 0.05, 0.55, 0.55, 1.0])
    off = np.array([False, False, True, False, True])
    assert [(row["predicted"], row["observed"], row["frames"]) for row in calibration(p, off)] == [
        (pytest.approx(0.025), 0.0, 2), (pytest.approx(0.55), 0.5, 2), (1.0, 1.0, 1),
    ]  # fmt: skip


def test_only_valid_frames_fail_silently() -> None:
    error_m = np.array([0.01, 0.2, 0.2, 0.07, np.nan])
    found = score_failures(error_m, np.array([0.1, 0.2, 0.9, np.nan, 0.5]), np.array([True, True, False, True, True]))
    assert found["silent_rows"] == [1] and (found["frames"], found["off"], found["silent"]) == (4, 3, 1)
    assert found["brier"] == pytest.approx((0.1**2 + 0.8**2 + 0.1**2) / 3) and found["auroc"] == 1.0
    unknown = score_failures(np.full(3, np.nan), np.full(3, np.nan), np.ones(3, bool))
    assert unknown["silent"] == 0 and np.isnan(unknown["auroc"])
