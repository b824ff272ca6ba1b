"""Evaluation with a world made by hand: a renderer whose errors are known, so every score can be foretold."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from sigmasplat.config import Config, InputConfig
from sigmasplat.errors import RunError, SourceError
from sigmasplat.evaluate import evaluate
from sigmasplat.io.runs import RunFolder
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.base import Source

CAMERA = Camera(48, 36, 40.0, 40.0, 23.5, 17.5)
FRAMES = 20
CONFIG = replace(Config(), name="hand-made", input=InputConfig(max_depth_m=4.0))


class HandMade(Source):
    """Textured frames 2 m away, without a reading in the left quarter, 9 m away at the right edge."""

    def __init__(self, truth: Trajectory | None) -> None:
        super().__init__("hand-made", CAMERA)
        self._truth = truth

    def __len__(self) -> int:
        return FRAMES

    def frame(self, i: int) -> Frame:
        depth = np.full((36, 48), 2.0, np.float32)
        depth[:, :12] = 0.0
        depth[:, -4:] = 9.0
        return Frame(i, i / 30.0, picture(i), depth, CAMERA)

    def truth(self) -> Trajectory | None:
        return self._truth


def picture(i: int) -> np.ndarray:
    rng = np.random.default_rng(i)
    return (rng.uniform(0.3, 0.6, (36, 48, 3)) + 0.01 * i).astype(np.float32)


def poses() -> np.ndarray:
    return np.stack([se3.exp(np.array([0.1 * i, 0.02 * i**1.5, 0, 0, 0.01 * i, 0])) for i in range(FRAMES)])


TIMES = np.arange(FRAMES) / 30.0
WORLD = se3.exp(np.array([5.0, 6, 7, 0.5, 1.0, 1.5]))


class KnownErrors:
    """Render frame i, recognised by its pose, with a ramp of errors whose squares V predicts exactly."""

    def __init__(self, training: float = 0.01, held_out: float = 0.04) -> None:
        self.offsets = {True: training, False: held_out}
        self.seen: list[int] = []

    def __call__(self, field: GaussianField, camera: Camera, T_camera_world: np.ndarray) -> Any:
        assert camera == CAMERA and len(field) == 3
        distance = np.abs(se3.inverse(poses()) - T_camera_world).max((1, 2))
        i = int(distance.argmin())
        assert distance[i] < 1e-9, "rendered at the estimated pose"
        self.seen.append(i)
        ramp = np.linspace(0.5, 1.5, 36, dtype=np.float32)[:, None, None] * self.offsets[i % 4 == 0]
        color = picture(i) + ramp
        alpha = np.full((36, 48), 0.8, np.float32)
        alpha[:6] = 0.3
        variance = np.broadcast_to(ramp**2, color.shape).copy()
        maps = {"color": color, "depth": 2.05 * alpha, "alpha": alpha, "variance": variance}
        return SimpleNamespace(**{name: torch.from_numpy(value).requires_grad_() for name, value in maps.items()})


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder.create(tmp_path / "run", CONFIG, "hand-made")
    for i in range(FRAMES):
        record = {"index": i, "timestamp_s": TIMES[i], "is_keyframe": i % 4 == 0, "lost": i in (6, 7)}
        run.log(record | {"seconds": {"tracking": 0.1, "mapping": 0.15}})
    run.write_trajectory(Trajectory(TIMES, poses()))
    run.write_map(GaussianField(torch.ones(3, 17)))
    return run


def score(run: RunFolder, source: Source, **options: Any) -> dict[str, Any]:
    """Evaluate without drawing strips unless asked: they are the slow part."""
    return evaluate(run, source, **{"renderer": KnownErrors(), "strips_per_kind": 0} | options)


def truth_of(move: Callable[[np.ndarray], np.ndarray] = lambda T: T) -> Trajectory:
    return Trajectory(TIMES + 0.004, move(WORLD @ poses()))


def test_training_and_held_out_views_are_kept_apart(run: RunFolder) -> None:
    metrics = score(run, HandMade(truth_of()))
    ramp = np.linspace(0.5, 1.5, 36)
    for kind, offset, views in (("training", 0.01, 5), ("held_out", 0.04, 15)):
        assert metrics[kind]["views"] == views
        assert metrics[kind]["psnr_db"] == pytest.approx(-10 * np.log10((ramp**2).mean() * offset**2), abs=1e-3)
        assert metrics[kind]["depth_l1_m"] == pytest.approx(0.05, abs=1e-5), "Σwz/Σw, beyond 4 m is no reading"
        assert metrics[kind]["depth_coverage"] == pytest.approx(30 / 36)


def test_uncertainty_is_judged_on_held_out_views(run: RunFolder) -> None:
    scores = score(run, HandMade(None), renderer=KnownErrors(training=0.3))["uncertainty"]
    assert scores["pixels"] == 15 * 36 * 32, "pixels with a reading only"
    assert scores["spearman"] == pytest.approx(1.0, abs=1e-3) and scores["ause"] == pytest.approx(0.0, abs=1e-3)
    assert scores["mean_variance"] == pytest.approx(scores["mean_squared_error"], rel=1e-3)
    assert scores["mean_variance"] < 0.01, "training views with their 0.3 would stand out"


def test_path_and_facts(run: RunFolder) -> None:
    def half_of_them_off(T: np.ndarray) -> np.ndarray:
        out = T.copy()
        out[::2, 2, 3] += 0.1
        return out

    metrics = score(run, HandMade(truth_of(half_of_them_off)))
    assert metrics["ate"]["pairs"] == FRAMES and metrics["ate"]["rmse_m"] == pytest.approx(0.05, rel=0.05)
    assert metrics["rpe"]["translation_rmse_m"] == pytest.approx(0.1, rel=1e-6)
    assert metrics["lost_frames"] == [6, 7] and metrics["lost"] == 2 and metrics["splats"] == 3
    assert metrics["frames"] == 20 and metrics["keyframes"] == 5 and metrics["frames_per_s"] == pytest.approx(4.0)
    run.note(wall_s=10.0)
    assert score(run, HandMade(None))["frames_per_s"] == 2.0


def test_everything_is_written(run: RunFolder) -> None:
    metrics = score(run, HandMade(truth_of()), strips_per_kind=2)
    assert json.loads((run.path / "metrics.json").read_text())["held_out"] == metrics["held_out"]
    page = (run.path / "report.html").read_text()
    named = {name for name in (p.name for p in run.images.iterdir()) if f"images/{name}" in page}
    assert named == {p.name for p in run.images.iterdir()} and len(named) == 8
    assert "images/view-training-000000.png" in page and "images/view-held-out-000019.png" in page


def test_views_are_sampled_evenly(run: RunFolder) -> None:
    renderer, told = KnownErrors(), []
    score(run, HandMade(None), renderer=renderer, views_per_kind=3, progress=lambda *at: told.append(at))
    assert sorted(renderer.seen) == [0, 1, 8, 10, 16, 19]
    assert told == [(i, 6) for i in range(1, 7)]


def test_an_interrupted_run_is_scored_as_far_as_it_came(run: RunFolder) -> None:
    run.write_trajectory(Trajectory(TIMES[:9], poses()[:9]))
    metrics = score(run, HandMade(truth_of()))
    assert metrics["frames"] == 9 and metrics["ate"]["pairs"] == 9


def test_a_run_of_keyframes_only_has_no_held_out_views(run: RunFolder) -> None:
    lines = [json.loads(line) | {"is_keyframe": True} for line in (run.path / "log.jsonl").read_text().splitlines()]
    (run.path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    metrics = score(run, HandMade(None), renderer=KnownErrors(), views_per_kind=4)
    assert metrics["held_out"] == {"views": 0} and metrics["uncertainty"] is None and metrics["ate"] is None
    assert (run.path / "report.html").exists()


def test_truth_of_another_recording_is_said_after_the_rest_is_kept(run: RunFolder) -> None:
    late = Trajectory(TIMES + 1000, WORLD @ poses())
    with pytest.raises(SourceError, match="share no timestamps"):
        score(run, HandMade(late))
    assert run.read_metrics()["held_out"]["views"] == 15
    assert "share no timestamps" in (run.path / "report.html").read_text()


def test_runs_without_frames_or_of_two_sessions_are_refused(run: RunFolder) -> None:
    run.write_trajectory(Trajectory(TIMES + 50, poses()))
    with pytest.raises(RunError, match="share no timestamps; are they of one run"):
        score(run, HandMade(None))
    (run.path / "log.jsonl").write_text("")
    with pytest.raises(RunError, match=r"empty log\.jsonl"):
        score(run, HandMade(None))
