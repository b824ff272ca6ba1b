"""ATE and RPE against an independent implementation: quaternion eigenvectors and scipy rotations, no SVD."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.plugins.evaluation.metrics.trajectory import (
    align_rigid,
    align_similarity,
    associate,
    ate,
    pair_poses,
    rpe,
)

Array = np.ndarray


def random_path(seed: int, n: int = 60, spread_m: float = 2.0) -> Trajectory:
    """Return a random path: smooth positions, any rotations."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=seed).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(0, spread_m / np.sqrt(n), (n, 3)), 0)
    return Trajectory(1305031102.175304 + np.arange(n) / 30.0, poses)


def disturbed(path: Trajectory, seed: int, metres: float, radians: float) -> Trajectory:
    """Add noise to each pose, then transform the whole path to another world frame."""
    rng = np.random.default_rng(seed)
    poses = path.T_world_camera.copy()
    poses[:, :3, 3] += rng.normal(0, metres, (len(path), 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, radians, (len(path), 3))).as_matrix()
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(0, 5, 3)
    return Trajectory(path.timestamps_s, T @ poses)


def horn(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """Fit rotation and translation by Horn's 4×4 quaternion matrix (1987): its largest eigenvector is the rotation."""
    a, b = estimate - estimate.mean(0), truth - truth.mean(0)
    S = a.T @ b
    delta = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    N = np.block([[np.trace(S), delta[None]], [delta[:, None], S + S.T - np.trace(S) * np.eye(3)]])
    w, x, y, z = np.linalg.eigh(N)[1][:, -1]
    R = Rotation.from_quat([x, y, z, w]).as_matrix()
    return R, truth.mean(0) - R @ estimate.mean(0)


def test_ate_equals_the_independent_implementation() -> None:
    for seed in range(5):
        truth = random_path(seed)
        estimate = disturbed(truth, seed + 100, 0.05, 0.02)
        ours, theirs = estimate.T_world_camera[:, :3, 3], truth.T_world_camera[:, :3, 3]
        R, t = horn(ours, theirs)
        distance = np.sqrt((((R @ ours.T).T + t - theirs) ** 2).sum(1))
        score = ate(estimate, truth)
        assert score.rmse_m == pytest.approx(np.sqrt((distance**2).mean()), abs=1e-9)
        assert score.mean_m == pytest.approx(distance.mean(), abs=1e-9)
        assert score.median_m == pytest.approx(np.median(distance), abs=1e-9)
        assert score.max_m == pytest.approx(distance.max(), abs=1e-9)
        assert score.pairs == len(truth)
        turn, _ = Rotation.align_vectors(theirs - theirs.mean(0), ours - ours.mean(0))
        np.testing.assert_allclose(align_rigid(ours, theirs)[:3, :3], turn.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("delta", [1, 7])
def test_rpe_equals_the_independent_implementation(delta: int) -> None:
    truth = random_path(3)
    estimate = disturbed(truth, 4, 0.03, 0.05)
    shifts, angles = [], []
    for i in range(len(truth) - delta):
        q = np.linalg.inv(truth.T_world_camera[i]) @ truth.T_world_camera[i + delta]
        p = np.linalg.inv(estimate.T_world_camera[i]) @ estimate.T_world_camera[i + delta]
        E = np.linalg.inv(q) @ p
        shifts.append(E[:3, 3] @ E[:3, 3])
        angles.append(Rotation.from_matrix(E[:3, :3]).magnitude() ** 2)
    score = rpe(estimate, truth, delta)
    assert score["translation_rmse_m"] == pytest.approx(np.sqrt(np.mean(shifts)), abs=1e-9)
    assert score["rotation_rmse_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(angles))), abs=1e-9)
    assert score["pairs"] == len(truth) - delta


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_rigidly_transformed_copy_has_no_error(seed: int) -> None:
    truth = random_path(seed, n=20)
    moved = disturbed(truth, seed, 0.0, 0.0)
    assert ate(moved, truth).rmse_m < 1e-9
    assert rpe(moved, truth)["translation_rmse_m"] < 1e-9
    assert rpe(moved, truth)["rotation_rmse_deg"] < 1e-5


def test_a_mirrored_path_is_not_aligned_by_a_reflection() -> None:
    """A reflection fits perfectly, but is not a rigid motion."""
    points = np.random.default_rng(0).normal(size=(30, 3))
    T = align_rigid(points * [1, 1, -1], points)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm((points * [1, 1, -1]) @ T[:3, :3].T + T[:3, 3] - points, axis=1).mean() > 0.1


def test_alignment_does_not_change_the_scale() -> None:
    """A wrong scale counts as an error: at twice the size, the error of a point is its distance from the centre."""
    line = np.zeros((11, 3))
    line[:, 0] = np.linspace(-0.5, 0.5, 11)
    identity = np.tile(np.eye(4), (11, 1, 1))
    one, two = identity.copy(), identity.copy()
    one[:, :3, 3], two[:, :3, 3] = line, 2 * line
    times = np.arange(11.0)
    assert ate(Trajectory(times, two), Trajectory(times, one)).rmse_m == pytest.approx(np.sqrt((line**2).sum() / 11))


def test_association_is_one_to_one_and_nearest() -> None:
    frames = np.arange(10) / 30.0
    slow = frames[::3] + 0.004
    rows, others = associate(frames, slow)
    np.testing.assert_array_equal(rows, [0, 3, 6, 9])
    np.testing.assert_array_equal(others, [0, 1, 2, 3])
    fast = np.arange(0, 0.4, 0.01)[::-1]
    rows, others = associate(frames, fast)
    np.testing.assert_array_equal(rows, np.arange(10))
    np.testing.assert_allclose(fast[others], np.round(frames, 2), atol=1e-9)


def test_association_matches_brute_force() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0, 3, 40), rng.uniform(0, 3, 70)
    gap = np.abs(a[:, None] - b[None])
    nearest = [(i, int(gap[i].argmin())) for i in range(40) if gap[i].min() <= 0.02]
    expected = [(i, j) for i, j in nearest if gap[:, j].argmin() == i]
    assert list(zip(*(rows.tolist() for rows in associate(a, b)), strict=True)) == expected


def test_poses_are_paired_by_time_not_by_row() -> None:
    truth = random_path(1)
    some = np.array([40, 3, 17, 25])
    estimate = Trajectory(truth.timestamps_s[some] + 0.005, truth.T_world_camera[some])
    ours, theirs = pair_poses(estimate, truth)
    np.testing.assert_array_equal(ours, theirs)


def test_timestamps_without_overlap_are_refused() -> None:
    truth = random_path(1)
    late = Trajectory(truth.timestamps_s + 1e4, truth.T_world_camera)
    with pytest.raises(SourceError, match=r"share no timestamps within 0\.02 s: .* \(60 poses\)"):
        ate(late, truth)


def test_a_single_pair_has_no_relative_error() -> None:
    truth = random_path(1)
    one = Trajectory(truth.timestamps_s[:1], truth.T_world_camera[:1])
    assert ate(one, truth).rmse_m == pytest.approx(0.0, abs=1e-12)
    assert rpe(one, truth)["pairs"] == 0 and np.isnan(rpe(one, truth)["translation_rmse_m"])


def test_a_similarity_finds_scale_rotation_and_shift() -> None:
    points, turn = np.random.default_rng(3).normal(size=(20, 3)), Rotation.from_euler("xyz", [0.3, -0.5, 1.0])
    scale, T = align_similarity(points, 2.5 * turn.apply(points) + [1.0, 2.0, 3.0])
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(T[:3, :3], turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 3.0], atol=1e-9)
    assert align_similarity(np.ones((4, 3)), points[:4])[0] == 1.0
