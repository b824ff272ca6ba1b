"""Paths with covariances: the files that `sigmasplat export` writes, what they mean, and how they are scored."""

import json
from itertools import accumulate
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from command_line import exit_code
from room_run import LOST, PATH, made_run
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.relative_pose import Edges, RelativePose
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.graph.path_covariance import PathCovariance, recorded
from sigmasplat.plugins.evaluation.metrics.trajectory import score_covariances
from sigmasplat.plugins.evaluation.path_scores import score_path_covariance
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.trajectory import KNOWN, write_square, write_trajectory

Array = NDArray[np.float64]
CALIBRATED = 2.366
"""Median of χ² with three degrees of freedom."""


def estimated(count: int, scale: float = 1.0) -> tuple[Trajectory, Trajectory, Array]:
    """Return the true path, an estimate drawn around it, and the covariance that it claims: `scale` times the right
    one."""
    rng = np.random.default_rng(0)
    true = se3.exp_stack(rng.normal(size=(count, 6)) * [2.0, 1.0, 2.0, 0.3, 1.0, 0.3])
    halves = rng.normal(size=(count, 6, 6)) * np.repeat([0.02, 0.01], 3)[:, None]
    twists = (halves @ rng.normal(size=(count, 6, 1)))[..., 0]
    times_s = np.arange(count) / 30.0
    # The claim is about the true pose, given the estimate: T_true = exp(ξ) T_estimate.
    estimate = se3.inverse(se3.exp_stack(twists)) @ true
    covariance = scale * halves @ np.swapaxes(halves, 1, 2)
    return Trajectory(times_s, true), Trajectory(times_s, estimate), covariance


@pytest.mark.parametrize(("scale", "k"), [(1.0, 1.0), (0.25, 4.0)])
def test_smfeval_reads_the_file_and_agrees_on_k(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: float, k: float
) -> None:
    smfeval = pytest.importorskip("smfeval.cli.main", reason="smfeval is not installed (make install-dev)")
    true, estimate, covariance = estimated(400, scale)
    estimate.T_world_camera[0] = true.T_world_camera[0]
    covariance[0] = 0.0  # of the first frame, as in a run
    write_square(tmp_path / "path.cov.txt", estimate, covariance)
    write_trajectory(tmp_path / "true.txt", true)
    files = str(tmp_path / "path.cov.txt"), str(tmp_path / "true.txt")
    assert smfeval.main(["validate", "--strict", files[0]]) == 0
    capsys.readouterr()
    assert smfeval.main(["nees", *files, "--align", "none", "--ref-body-frame", "camera", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    ours = score_covariances(estimate.T_world_camera[1:], true.T_world_camera[1:], covariance[1:])
    assert ours is not None and found["n"] == ours["count"] + 1
    assert ours["position_k"] == pytest.approx(k, rel=0.25)
    assert found["k"] == pytest.approx(ours["position_k"], rel=0.05)
    assert found["coverage"] == pytest.approx(ours["position_coverage_90"], abs=0.02)


def test_coverage_and_nees_of_right_and_of_small_covariances() -> None:
    true, estimate, covariance = estimated(4000)
    right = score_covariances(estimate.T_world_camera, true.T_world_camera, covariance)
    small = score_covariances(estimate.T_world_camera, true.T_world_camera, covariance / 9.0)
    assert right is not None and small is not None
    assert right["count"] == 4000 and right["nees_mean"] == pytest.approx(6.0, rel=0.05)
    assert right["coverage_90"] == pytest.approx(0.9, abs=0.02)
    assert right["position_coverage_90"] == pytest.approx(0.9, abs=0.02)
    assert right["position_nees_median"] == pytest.approx(CALIBRATED, rel=0.1)
    assert small["nees_mean"] == pytest.approx(9.0 * right["nees_mean"]) and small["coverage_90"] < 0.4
    assert score_covariances(np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.empty((0, 6, 6))) is None


class Chain:
    """A path of independent hops, each with the covariance `hop` [6, 6] of its left twist."""

    def __init__(self, T_hops: Array, hop: Array) -> None:
        self.T_world_camera = np.array([*accumulate(T_hops, np.matmul, initial=np.eye(4))])
        self.hop = hop

    def between(self, a: int, b: int) -> Array:
        A = se3.adjoint(se3.inverse(self.T_world_camera[a]) @ self.T_world_camera[a:b])
        return np.asarray((A @ self.hop @ np.swapaxes(A, 1, 2)).sum(0))


def score_with_truth(rms: tuple[float, float] | None, error: tuple[float, float]) -> dict[str, Any]:
    """Score a path with known covariance against a truth of which each pose has an error of its own; rms: as said."""
    rng, frames, hop = np.random.default_rng(5), np.arange(400), np.repeat([2e-4, 1e-4], 3)
    T_hops = se3.exp_stack(rng.normal(size=(len(frames) - 1, 6)) * np.repeat([0.03, 0.02], 3))
    estimate = Chain(T_hops, np.diag(hop**2))
    true = Chain(se3.exp_stack(rng.normal(size=(len(T_hops), 6)) * hop) @ T_hops, estimate.hop).T_world_camera
    measured = true @ se3.exp_stack(rng.normal(size=(len(true), 6)) * np.repeat(error, 3) / np.sqrt(3.0))
    path, truth = Trajectory(frames / 30.0, estimate.T_world_camera), Trajectory(frames / 30.0, measured, rms)
    return score_path_covariance(cast(PathCovariance, estimate), path, frames, frames.tolist(), truth)


def test_with_the_own_error_of_the_truth_a_right_covariance_covers() -> None:
    found = score_with_truth((0.004, 0.005), (0.004, 0.005))
    assert found["truth_error_m"] == 0.004 and found["truth_error_deg"] == pytest.approx(np.rad2deg(0.005))
    for kind in ("hops", "windows"):
        scores = found[kind]
        assert scores["coverage_90"] < 0.5 and scores["position_coverage_90"] < 0.5 and scores["position_k"] > 3.0
        assert scores["coverage_90_with_truth"] == pytest.approx(0.9, abs=0.04), kind
        assert scores["position_coverage_90_with_truth"] == pytest.approx(0.9, abs=0.04), kind
        assert scores["position_k_with_truth"] == pytest.approx(1.0, abs=0.2), kind


@pytest.mark.parametrize("rms", [(0.0, 0.0), None])
def test_an_exact_or_unknown_truth_adds_nothing(rms: tuple[float, float] | None) -> None:
    found = score_with_truth(rms, (0.0, 0.0))
    assert found["truth_error_m"] == found["truth_error_deg"] == (0.0 if rms else None)
    assert found["hops"]["coverage_90"] == pytest.approx(0.9, abs=0.04)
    assert not [name for name in found["hops"] if name.endswith("_with_truth")]


def test_the_file_holds_the_spread_in_the_camera(tmp_path: Path) -> None:
    """Draw poses around one pose: the file describes their spread in the camera's axes."""
    rng = np.random.default_rng(3)
    A = 1e-3 * rng.normal(size=(6, 6))
    T = se3.exp(np.array([2.0, -1.0, 3.0, 0.4, -0.8, 0.2]))
    drawn = se3.exp_stack(rng.normal(size=(100_000, 6)) @ A.T) @ T
    path = Trajectory(np.zeros(1), T[None])
    write_square(tmp_path / "a.cov.txt", path, (A @ A.T)[None])

    lower = np.loadtxt(tmp_path / "a.cov.txt")[8:]
    assert len(lower) == 21
    square = np.zeros((6, 6))
    square[np.tril_indices(6)] = lower
    in_camera = np.cov(se3.log_stack(se3.inverse(T) @ drawn).T)
    np.testing.assert_allclose(square, np.tril(in_camera), atol=0.02 * in_camera.max())


def with_errors(folder: Path) -> tuple[RunFolder, PathCovariance]:
    """Make a run that recorded the errors of its path: keyframes 0, 2 and 4 in one submap."""
    run, atlas, poses = made_run(folder, submaps=False), Atlas(), PATH.T_world_camera
    atlas.begin_submap()
    keyframes: list[Array] = []
    for i, T in enumerate(poses):
        if i in (0, 2, 4):
            before = keyframes[-1] if keyframes else T
            keyframes = [*keyframes, T]
            hop = RelativePose.hop(se3.inverse(T) @ before, np.diag([1e-6] * 3 + [1e-7] * 3), np.full(6, 1e-4))
            atlas.set_keyframes(keyframes, hop)
        atlas.place_frame(T)
    tensors, _ = run.read_checkpoint()
    tensors |= recorded(atlas, Edges()) | {
        "T_world_submap": torch.eye(4, dtype=torch.float64)[None],
        "submap_component": torch.zeros(1, dtype=torch.int64),
        "frame_submap": torch.zeros(len(poses), dtype=torch.int64),
    }
    run.write_checkpoint(tensors, {})
    errors = PathCovariance.of(tensors)
    assert errors is not None
    return run, errors


def test_a_run_is_exported_with_the_covariance_of_its_valid_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, errors = with_errors(tmp_path / "kitchen")
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "path.cov.txt")) == 0
    said = capsys.readouterr().out
    assert "path.cov.txt: 5 poses with their covariance; left out: 1 lost" in said
    rows = np.loadtxt(tmp_path / "path.cov.txt")
    valid = np.delete(np.arange(len(PATH)), LOST)
    assert rows.shape == (5, 29)
    np.testing.assert_allclose(rows[:, 1:4], PATH.T_world_camera[valid, :3, 3], atol=1e-9)
    np.testing.assert_allclose(rows[0, 8:], KNOWN[np.tril_indices(6)], atol=1e-20)
    for row, frame in zip(rows[1:], valid[1:], strict=True):
        A = se3.adjoint(se3.inverse(PATH.T_world_camera[frame]))
        expected = A @ errors.of_frame(int(frame)) @ A.T
        np.testing.assert_allclose(row[8:], expected[np.tril_indices(6)], rtol=1e-6, atol=1e-11)


def test_a_run_without_errors_of_its_path_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = made_run(tmp_path / "kitchen", submaps=False)
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "path.cov.txt")) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "did not record the errors of its path" in said[0]
    assert not (tmp_path / "path.cov.txt").exists()
