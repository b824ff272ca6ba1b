"""Predicted depth: its scale, shift and smooth error are found from the map and from other views."""

from pathlib import Path

import numpy as np
import pytest

from paper_settings import InputConfig
from sigmasplat.config import Config
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.opening import open_source
from sigmasplat.input.source import Subset
from sigmasplat.plugins.evaluation.metrics.trajectory import align_similarity
from sigmasplat.plugins.evaluation.path_scores import arbitrary_scale, in_metres, in_units_of_run
from sigmasplat.run.scene import config_of_facts, scene_facts
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.predicted_depth_fit import DepthFit, pixel_noise, smoothed

HEIGHT, WIDTH = 96, 128


def scene_m() -> np.ndarray:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return (1.0 + 2.0 * u / WIDTH + 0.5 * np.sin(v / 9.0)).astype(np.float32)


def test_the_fit_finds_scale_and_shift_among_outliers_and_leaves_holes() -> None:
    known, rng = scene_m(), np.random.default_rng(0)
    predicted = (0.93 / (1.0 / known - 0.01)).astype(np.float32)
    predicted[:40, :30] *= 3.0
    predicted[50:60] = 0.0
    fit = DepthFit()
    for _ in range(3):
        fit = fit.fitted(predicted * (1.0 + 0.1 * rng.standard_normal(known.shape, np.float32)), known)
    used = fit.applied(predicted)
    before, after = (np.median(np.abs(d[60:] / known[60:] - 1.0)) for d in (predicted, used))
    assert after < 0.7 * before and (used[50:60] == 0.0).all() and np.isfinite(used).all()
    assert fit.fitted(predicted, np.zeros_like(known)) is fit, "nothing is known"
    assert 0.85 < fit.scale < 1.0


def test_noise_of_pixels_is_measured_and_smoothed_but_not_edges() -> None:
    exact = np.where(np.arange(WIDTH) < 64, 1.0, 3.0) * np.ones((HEIGHT, 1))
    noisy = (exact * (1.0 + 0.1 * np.random.default_rng(1).standard_normal(exact.shape))).astype(np.float32)
    noisy[:5] = 0.0
    assert pixel_noise(noisy) == pytest.approx(0.1, rel=0.15)
    smooth = smoothed(noisy)
    assert np.std((smooth / exact)[5:]) < 0.04 and (smooth[:5] == 0.0).all()
    assert np.array_equal(smoothed(scene_m() * 0), scene_m() * 0)


def test_the_settings_follow_from_the_source_and_from_the_facts_of_the_run() -> None:
    source = Subset(open_source("synthetic:frames=4,width=40,height=30,predicted=1"), InputConfig())
    config = config_of_facts(scene_facts(source), Config())
    assert config.tracking.fit_depth and config.render.depth_noise_per_m == 0.1
    assert config_of_facts(scene_facts(source), Config()) == config
    assert not config_of_facts(scene_facts(source), Config(), ["tracking.fit_depth"]).tracking.fit_depth
    assert not config_of_facts(scene_facts(open_source("synthetic:frames=4")), Config()).tracking.fit_depth


def test_the_scale_of_a_path_is_found_for_predicted_depth_only(tmp_path: Path) -> None:
    random, poses = np.random.default_rng(2), np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, 3] = random.normal(size=(9, 3))
    path = Trajectory(np.arange(9.0), poses)
    truth = in_units_of_run(path, 0.5)  # twice as large
    run = RunFolder.create(tmp_path / "run", Config(), "room")
    assert arbitrary_scale(run, path, truth) is None and in_units_of_run(truth, None) is truth
    run.note(predicted_depth=True)
    scale = arbitrary_scale(run, path, truth)
    assert scale == pytest.approx(2.0) and arbitrary_scale(run, path, None) is None
    np.testing.assert_allclose(in_units_of_run(truth, scale).T_world_camera, poses)
    metres = in_metres({"ate": {"rmse_m": 0.1, "pairs": 9}, "rpe": None}, scale)
    assert metres["ate"] == pytest.approx({"rmse_m": 0.2, "pairs": 9}) and metres["rpe"] is None


def test_a_path_from_predicted_depth_has_the_shape_of_the_true_one() -> None:
    source = open_source("synthetic:frames=200,width=160,height=120,predicted=1", limit=16)
    quick = {"input.width": 160, "final.iterations": 0, "uncertainty.probes": 0, "mapping.iterations": 5}
    slam = Slam("sigma", settings=quick)
    slam = Slam(config_of_facts(scene_facts(source), slam.config))
    for frame in source:
        slam.step(frame)
    assert not any(step.lost for step in slam.steps) and slam.tracker.depth.shape.views
    ours, truth = (path.T_world_camera[:16, :3, 3] for path in (slam.trajectory(), source.truth()))
    scale, T = align_similarity(ours, truth)
    error = np.linalg.norm(scale * ours @ T[:3, :3].T + T[:3, 3] - truth, axis=1)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt((error**2).mean()) < 0.05 * length
