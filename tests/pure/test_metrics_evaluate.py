"""Evaluation of a hand-made run with a renderer of known errors, so that every score is known in advance."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from lpips_weights import write_weights
from paper_settings import FinalConfig, InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.data.trajectory import Component, Trajectory
from sigmasplat.errors import RunError, SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.submaps import DiskStore

CAMERA = Camera(48, 36, 40.0, 40.0, 23.5, 17.5)
FRAMES = 20
CONFIG = replace(BASE, name="hand-made", input=InputConfig(max_depth_m=4.0))


class HandMade(Source):
    """Textured frames at 2 m, without depth in the left quarter, at 9 m along the right edge."""

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
    """Render frame i, recognised by its pose, with a ramp of errors. V equals the squared errors."""

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
        record = {"index": i, "timestamp_s": TIMES[i], "is_keyframe": i % 4 == 0, "lost": False}
        run.log(record | {"seconds": {"tracking": 0.1, "mapping": 0.15}})
    run.write_trajectory(Trajectory(TIMES, poses()))
    run.write_map(GaussianField(torch.ones(3, 17)))
    return run


def score(run: RunFolder, source: Source, **options: Any) -> dict[str, Any]:
    """Evaluate; by default without views on the page, which are slow to draw."""
    return evaluate(run, source, **{"renderer": KnownErrors(), "strips_per_kind": 0} | options)


def truth_of(move: Callable[[np.ndarray], np.ndarray] = lambda T: T) -> Trajectory:
    return Trajectory(TIMES + 0.004, move(WORLD @ poses()))


def test_training_and_held_out_views_are_separate(run: RunFolder) -> None:
    metrics = score(run, HandMade(truth_of()))
    ramp = np.linspace(0.5, 1.5, 36)
    for kind, offset, views in (("training", 0.01, 5), ("held_out", 0.04, 15)):
        assert metrics[kind]["views"] == views
        assert metrics[kind]["psnr_db"] == pytest.approx(-10 * np.log10((ramp**2).mean() * offset**2), abs=1e-3)
        assert metrics[kind]["depth_l1_m"] == pytest.approx(0.05, abs=1e-5), "Σwz/Σw, beyond 4 m is no reading"
        assert metrics[kind]["depth_coverage"] == pytest.approx(30 / 36)


def test_uncertainty_is_scored_on_held_out_views(run: RunFolder) -> None:
    scores = score(run, HandMade(None), renderer=KnownErrors(training=0.3))["uncertainty"]
    assert scores["judged_on"] == "held-out"
    assert scores["pixels"] == 15 * 36 * 32, "only pixels with a depth reading"
    assert scores["spearman"] == pytest.approx(1.0, abs=1e-3) and scores["ause"] == pytest.approx(0.0, abs=1e-3)
    assert scores["mean_variance"] == pytest.approx(scores["mean_squared_error"], rel=1e-3)
    assert scores["mean_variance"] < 0.01, "training views, with 0.3, do not count"


def test_path_and_facts(run: RunFolder) -> None:
    def half_of_them_off(T: np.ndarray) -> np.ndarray:
        out = T.copy()
        out[::2, 2, 3] += 0.1
        return out

    metrics = score(run, HandMade(truth_of(half_of_them_off)))
    assert metrics["ate"]["pairs"] == FRAMES and metrics["ate"]["rmse_m"] == pytest.approx(0.05, rel=0.05)
    assert metrics["rpe"]["translation_rmse_m"] == pytest.approx(0.1, rel=1e-6)
    assert metrics["lost_frames"] == [] and metrics["lost"] == 0 and metrics["splats"] == 3
    assert metrics["believed"] == FRAMES and metrics["failures"]["silent"] == 0
    assert metrics["frames"] == 20 and metrics["keyframes"] == 5 and metrics["frames_per_s"] == pytest.approx(4.0)
    run.note(wall_s=10.0)
    metrics = score(run, HandMade(None))
    assert metrics["frames_per_s"] == 2.0 and metrics["total_s"] is None
    run.note(finish_s=2.5)
    assert score(run, HandMade(None))["total_s"] == 12.5


def rewritten_log(run: RunFolder, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    lines = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    (run.path / "log.jsonl").write_text("".join(json.dumps(line | change(line)) + "\n" for line in lines))


STATES = {6: "lost", 7: "relocalised", 12: "lost", 13: "apart", 14: "apart", 15: "lost", 16: "tracked"}


def test_states_and_silent_failures_are_scored(run: RunFolder) -> None:
    """Frame 10 is off by 30 cm and valid; lost frame 6 is off by 20 cm in the checkpoint, frame 12 is not off."""
    p_off = {6: 0.9, 10: 0.75, 12: 0.3, 16: 0.8}
    rewritten_log(
        run,
        lambda line: {
            "state": (state := STATES.get(line["index"], "tracked")), "lost": state == "lost",
            "p_off": p_off.get(line["index"], 0.1),
        },
    )  # fmt: skip
    estimate = poses()
    estimate[10, 1, 3] += 0.3
    estimate[6, 1, 3] += 0.2
    valid = [i for i in range(FRAMES) if STATES.get(i) not in ("lost", "apart")]
    run.write_trajectory(Trajectory(TIMES[valid], estimate[valid]))
    run.write_checkpoint({"T_world_camera": torch.from_numpy(estimate)}, {})
    run.write_components([Component(1, GaussianField(torch.ones(2, 17)), Trajectory(TIMES[13:15], poses()[:2]))])
    metrics = score(
        run, HandMade(truth_of()), renderer=lambda field, camera, T: KnownErrors()(field, camera, nearest(T))
    )
    assert (metrics["believed"], metrics["lost"], metrics["relocalised"], metrics["apart"]) == (15, 3, 1, 2)
    assert metrics["believed_share"] == 0.75 and metrics["lost_frames"] == [6, 12, 15]
    assert metrics["relocalised_frames"] == [7] and metrics["apart_frames"] == [13, 14]
    (component,) = metrics["components"]
    assert (component["number"], component["frames"]) == (1, 2)
    assert component["start_s"] == pytest.approx(TIMES[13]) and component["end_s"] == pytest.approx(TIMES[14])
    failures = metrics["failures"]
    assert failures["silent_frames"] == [10] and failures["silent"] == 1 and failures["off"] == 2
    assert failures["frames"] == 17, "valid ones, and lost ones in the world"
    assert failures["auroc"] == pytest.approx((15 + 14) / 30), "one frame that is not off has p = 0.8, above 0.75"
    wrong = [(1 - 0.9) ** 2, (1 - 0.75) ** 2, 0.3**2, 0.8**2, *[0.01] * 13]
    assert failures["brier"] == pytest.approx(sum(wrong) / 17)
    page = (run.path / "report.html").read_text()
    assert "States of the frames" in page and "State of each frame" in page
    assert "13–14" in page and "silent failures" in page


def nearest(T_camera_world: np.ndarray) -> np.ndarray:
    """Return the pose of the hand-made path that is nearest to a pose."""
    known = se3.inverse(poses())
    return known[np.abs(known - T_camera_world).max((1, 2)).argmin()]


def test_the_longest_frame_excludes_the_first_and_the_map_has_a_size(run: RunFolder) -> None:
    lines = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    lines[0]["seconds"], lines[7]["seconds"] = {"total": 9.0}, {"tracking": 0.1, "total": 0.7}
    (run.path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    metrics = score(run, HandMade(None))
    assert metrics["worst_frame_s"] == 0.7 and metrics["map_bytes"] == len((run.path / "map.ply").read_bytes()) > 100
    page = (run.path / "report.html").read_text()
    assert "<td>700 ms</td>" in page and "Map file" in page
    untimed = [line | {"seconds": {}} for line in lines]
    (run.path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in untimed))
    assert score(run, HandMade(None))["worst_frame_s"] is None


def test_everything_is_written(run: RunFolder) -> None:
    metrics = score(run, HandMade(truth_of()), strips_per_kind=2)
    assert json.loads((run.path / "metrics.json").read_text())["held_out"] == metrics["held_out"]
    page = (run.path / "report.html").read_text()
    assert "Path from above" in page
    assert page.count("alt='input'") == page.count("alt='error, RMS'") == 4
    assert "frame 0 · training" in page and "frame 19 · held-out" in page
    assert metrics["predictive"] is None, "the run did not measure how sure its map is"


def test_a_page_holds_three_views_of_each_kind(run: RunFolder) -> None:
    evaluate(run, HandMade(None), renderer=KnownErrors())
    page = (run.path / "report.html").read_text()
    for kind in ("held-out", "training"):
        shown = re.findall(rf"<span>frame (\d+) · {kind}</span>", page)
        assert len(shown) == len(set(shown)) == 3


def test_views_are_sampled_evenly(run: RunFolder) -> None:
    renderer, calls = KnownErrors(), []
    score(run, HandMade(None), renderer=renderer, views_per_kind=3, progress=lambda *at: calls.append(at))
    assert sorted(renderer.seen) == [0, 1, 8, 10, 16, 19]
    assert calls == [(i, 6) for i in range(1, 7)]


def test_a_run_of_keyframes_only_is_judged_on_training_views(run: RunFolder) -> None:
    lines = [json.loads(line) | {"is_keyframe": True} for line in (run.path / "log.jsonl").read_text().splitlines()]
    (run.path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    metrics = score(run, HandMade(None), renderer=KnownErrors(), views_per_kind=4)
    assert metrics["held_out"] == {"views": 0} and metrics["ate"] is None
    assert metrics["uncertainty"]["judged_on"] == "training" and metrics["uncertainty"]["pixels"] > 0
    page = (run.path / "report.html").read_text()
    assert "Uncertainty V, training" in page


def test_truth_of_another_recording_is_reported_after_everything_is_written(run: RunFolder) -> None:
    late = Trajectory(TIMES + 1000, WORLD @ poses())
    with pytest.raises(SourceError, match="share no timestamps"):
        score(run, HandMade(late))
    assert run.read_metrics()["held_out"]["views"] == 15
    assert "share no timestamps" in (run.path / "report.html").read_text()


CUTS = [0, 7, 12]
"""First frames of the submaps."""


def submap_of(frame: int) -> int:
    return sum(frame >= cut for cut in CUTS) - 1


def anchors() -> np.ndarray:
    """Return T_world_submap [3, 4, 4] as after loop closure: not the poses of the first frames."""
    return np.stack([np.eye(4), se3.exp(np.array([0.5, -0.2, 1, 0.1, 0.7, 0])), se3.exp(np.arange(6) / 5.0)])


class KnownInSubmaps:
    """Render like `KnownErrors`, but in a submap with other errors and at the pose of its frame in that submap."""

    def __init__(self) -> None:
        self.final, self.before = KnownErrors(), KnownErrors(training=0.02, held_out=0.06)
        self.check_submap = True

    def __call__(self, field: GaussianField, camera: Camera, T_camera_map: np.ndarray) -> Any:
        index = int(field.params[0, 0]) - 10
        if index < 0:
            return self.final(field, camera, T_camera_map)
        rendered = self.before(field, camera, T_camera_map @ se3.inverse(anchors()[index]))
        assert not self.check_submap or submap_of(self.before.seen[-1]) == index, (
            "the submap of the frame, as in the log"
        )
        return rendered


LOOPS = [
    {"query": 2, "database": 0, "query_frame": 14, "database_frame": 3, "similarity": 0.91, "residual": 0.0123,
     "overlap": 0.55, "translation_m": 0.0433, "rotation_deg": 1.21, "accepted": True, "reason": "accepted"},
    {"query": 2, "database": 1, "query_frame": 16, "database_frame": 8, "similarity": 0.84, "residual": None,
     "overlap": 0.04, "translation_m": 0.0, "rotation_deg": 0.0, "accepted": False, "reason": "overlap <0.2"},
]  # fmt: skip


@pytest.fixture
def cut_run(run: RunFolder) -> RunFolder:
    """Cut the run into three submaps, kept in its folder, with two loops tried."""
    lines = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    lines = [line | {"submap": submap_of(line["index"])} for line in lines]
    (run.path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    for index, cut in enumerate(CUTS):
        shown = [Picture(np.zeros((36, 48, 3), np.uint8), np.zeros((36, 48), np.float32))]
        field = GaussianField(torch.full((3, 17), 10.0 + index))
        run.submaps.save(Submap(index, field, (cut,), np.eye(4)[None], CAMERA), shown)
    run.write_checkpoint({"T_world_submap": torch.from_numpy(anchors())}, {})
    run.write_loops(LOOPS)
    run.note(finish_s=12.5)
    return run


def test_views_are_also_rendered_in_their_submaps(cut_run: RunFolder) -> None:
    metrics = score(cut_run, HandMade(None), renderer=KnownInSubmaps())
    ramp = np.linspace(0.5, 1.5, 36)
    for name, offset, views in (
        ("training", 0.01, 5), ("held_out", 0.04, 15), ("training_submaps", 0.02, 5), ("held_out_submaps", 0.06, 15),
    ):  # fmt: skip
        assert metrics[name]["views"] == views
        assert metrics[name]["psnr_db"] == pytest.approx(-10 * np.log10((ramp**2).mean() * offset**2), abs=1e-3)
    assert metrics["submaps"] == 3 and metrics["loops"] == {"tried": 2, "accepted": 1} and metrics["finish_s"] == 12.5


def test_each_submap_is_loaded_once_and_each_frame_read_once(
    cut_run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[int] = []
    load = DiskStore.load
    monkeypatch.setattr(DiskStore, "load", lambda store, index: (loaded.append(index), load(store, index))[1])
    source, renderer, read = HandMade(None), KnownInSubmaps(), []
    frame = source.frame
    monkeypatch.setattr(source, "frame", lambda i: (read.append(i), frame(i))[1])
    score(cut_run, source, renderer=renderer)
    assert loaded == [0, 1, 2] and sorted(read) == list(range(FRAMES))
    assert sorted(renderer.final.seen) == sorted(renderer.before.seen) == list(range(FRAMES))


@pytest.mark.parametrize(
    ("final", "keeps"),
    [
        (FinalConfig(iterations=0, uncertainty=False), True),
        (FinalConfig(iterations=9, uncertainty=True), True),
        (FinalConfig(iterations=9, uncertainty=False), False),
        (FinalConfig(iterations=9, seed_from="mesh", uncertainty=True), True),
        (FinalConfig(iterations=0, seed_from="mesh", uncertainty=True), False),
    ],
)
def test_uncertainty_is_scored_where_it_was_learned(cut_run: RunFolder, final: FinalConfig, keeps: bool) -> None:
    (cut_run.path / "config.json").write_text(json.dumps(replace(CONFIG, final=final).to_dict()))
    metrics = score(cut_run, HandMade(None), renderer=KnownInSubmaps())
    square = (np.linspace(0.5, 1.5, 36) ** 2).mean()
    assert metrics["uncertainty"]["mean_squared_error"] == pytest.approx(square * 0.06**2, rel=1e-3)
    if keeps:
        assert metrics["uncertainty_final"]["mean_squared_error"] == pytest.approx(square * 0.04**2, rel=1e-3)
    else:
        assert metrics["uncertainty_final"] is None


def test_submaps_are_on_the_page(cut_run: RunFolder) -> None:
    score(cut_run, HandMade(truth_of()), renderer=KnownInSubmaps(), strips_per_kind=1)
    page = (cut_run.path / "report.html").read_text()
    assert "Submaps; loops accepted" in page and "frame 1 · held-out · in submap 0" in page
    assert "held-out views, in their submaps" in page


def test_a_run_with_one_submap_has_no_scores_in_submaps(run: RunFolder) -> None:
    metrics = score(run, HandMade(None))
    assert metrics["submaps"] == 1 and metrics["loops"] == {"tried": 0, "accepted": 0} and metrics["finish_s"] is None
    assert metrics["held_out_submaps"] is metrics["training_submaps"] is metrics["uncertainty_final"] is None
    assert "Submaps" not in (run.path / "report.html").read_text()


@pytest.mark.parametrize("iterations", [0, 50])
def test_a_refined_single_submap_has_its_own_scores(run: RunFolder, iterations: int) -> None:
    config = replace(CONFIG, final=FinalConfig(iterations=iterations))
    (run.path / "config.json").write_text(json.dumps(config.to_dict()))
    shown = [Picture(np.zeros((36, 48, 3), np.uint8), np.zeros((36, 48), np.float32))]
    run.submaps.save(Submap(0, GaussianField(torch.full((3, 17), 10.0)), (0,), np.eye(4)[None], CAMERA), shown)
    run.write_checkpoint({"T_world_submap": torch.from_numpy(anchors()[:1])}, {})
    renderer = KnownInSubmaps()
    renderer.check_submap = False
    metrics = score(run, HandMade(None), renderer=renderer)
    assert metrics["submaps"] == 1
    for name in ("held_out_submaps", "training_submaps", "uncertainty_final"):
        assert (metrics[name] is not None) == bool(iterations)
    assert "Submaps; loops" not in (run.path / "report.html").read_text()


def lose_a_file(run: RunFolder) -> None:
    run.submaps.path(1).unlink()


def lose_the_anchors(run: RunFolder) -> None:
    run.write_checkpoint({"params": torch.zeros(1, 17)}, {})


def never_finish_the_last(run: RunFolder) -> None:
    run.submaps.path(2).unlink()


@pytest.mark.parametrize("lose", [lose_a_file, lose_the_anchors, never_finish_the_last])
def test_submaps_are_not_scored_if_one_is_missing(cut_run: RunFolder, lose: Callable[[RunFolder], None]) -> None:
    lose(cut_run)
    metrics = score(cut_run, HandMade(None), renderer=KnownInSubmaps())
    assert metrics["held_out"]["views"] == 15 and metrics["submaps"] == 3
    assert metrics["held_out_submaps"] is metrics["training_submaps"] is metrics["uncertainty_final"] is None
    square = (np.linspace(0.5, 1.5, 36) ** 2).mean()
    assert metrics["uncertainty"]["mean_squared_error"] == pytest.approx(square * 0.04**2, rel=1e-3)


def test_an_empty_log_and_a_log_of_another_run_are_refused(run: RunFolder) -> None:
    run.write_trajectory(Trajectory(TIMES + 50, poses()))
    with pytest.raises(RunError, match="share no timestamps"):
        score(run, HandMade(None))
    (run.path / "log.jsonl").write_text("")
    with pytest.raises(RunError, match=r"log\.jsonl"):
        score(run, HandMade(None))


class NovelViews(HandMade):
    """The same frames as test views. One cannot be read, one has no pose."""

    def __init__(self, poses: Trajectory | None) -> None:
        super().__init__(poses)

    def frame(self, i: int) -> Frame:
        if i == 3:
            raise SourceError("3.png: unreadable image")
        return super().frame(i)


class WithViews(HandMade):
    def __init__(self, truth: Trajectory | None, test_views: Source) -> None:
        super().__init__(truth)
        self._test_views = test_views

    def test_views(self) -> Source:
        return self._test_views


def test_novel_views_are_scored_at_their_true_poses(run: RunFolder) -> None:
    """The path of the run is exact, so the alignment is exact too, and each view is recognised by its pose."""
    truth = truth_of()
    known = Trajectory(truth.timestamps_s[:-1], truth.T_world_camera[:-1])
    renderer = KnownErrors(training=0.02, held_out=0.02)
    metrics = score(run, WithViews(truth, NovelViews(known)), renderer=renderer, strips_per_kind=2)
    assert metrics["test_views"]["views"] == FRAMES - 2
    assert metrics["test_views"]["psnr_db"] == pytest.approx(metrics["held_out"]["psnr_db"], abs=0.3)
    page = (run.path / "report.html").read_text()
    assert len(re.findall(r"<span>frame \d+ · test</span>", page)) == 2
    assert "<th>novel views</th>" in page and "<h3>novel views" in page


def test_novel_views_need_the_truth(run: RunFolder) -> None:
    assert score(run, HandMade(truth_of()))["test_views"] is None
    assert score(run, WithViews(None, NovelViews(truth_of())))["test_views"] is None
    assert score(run, WithViews(truth_of(), NovelViews(None)))["test_views"] is None


def test_the_path_is_scored_on_keyframes_and_on_all_frames(run: RunFolder) -> None:
    """Frames that are not keyframes alternate by ±20 cm; lost frame 6 is off by 1 m in the checkpoint."""
    rewritten_log(run, lambda line: {"state": "lost" if line["index"] == 6 else "tracked", "lost": line["index"] == 6})
    estimate = poses()
    estimate[1::4, 1, 3] += 0.2
    estimate[3::4, 1, 3] -= 0.2
    estimate[6, 1, 3] += 1.0
    valid = [i for i in range(FRAMES) if i != 6]
    run.write_trajectory(Trajectory(TIMES[valid], estimate[valid]))
    run.write_checkpoint({"T_world_camera": torch.from_numpy(estimate)}, {})
    metrics = score(
        run, HandMade(truth_of()), renderer=lambda field, camera, T: KnownErrors()(field, camera, nearest(T))
    )
    assert metrics["ate_keyframes"]["pairs"] == 5 and metrics["ate_keyframes"]["rmse_m"] < 1e-9
    assert metrics["ate"]["pairs"] == FRAMES - 1 and 0.1 < metrics["ate"]["rmse_m"] < 0.15
    assert metrics["ate_all_frames"]["pairs"] == FRAMES and metrics["ate_all_frames"]["max_m"] > 0.8
    page = (run.path / "report.html").read_text()
    assert "ATE rmse of keyframes (5 poses), cm" in page and "with lost ones (20 poses)" in page
    unknown = score(run, HandMade(None), renderer=lambda field, camera, T: KnownErrors()(field, camera, nearest(T)))
    assert unknown["ate_keyframes"] is unknown["ate_all_frames"] is None


def test_exposures_of_the_checkpoint_are_used_even_if_no_submaps_are_kept(run: RunFolder) -> None:
    """The images are twice as bright in the exposure of the map as recorded: the score with it differs."""
    plain = score(run, HandMade(truth_of()), renderer=Gray())
    half = np.tile([[0.5, 0.0]] * 3, (FRAMES, 1, 1))
    run.write_checkpoint({"exposure": torch.from_numpy(half)}, {})
    exposed = score(run, HandMade(truth_of()), renderer=Gray())
    for kind in ("training", "held_out"):
        if plain[kind]["views"]:
            assert exposed[kind]["psnr_neutral_db"] == pytest.approx(plain[kind]["psnr_db"])
            assert abs(exposed[kind]["psnr_db"] - plain[kind]["psnr_db"]) > 0.5
    assert plain["training"]["views"]


class Gray:
    """Renders gray at any size; the depth is exact."""

    def __call__(self, field: GaussianField, camera: Camera, T_camera_world: np.ndarray) -> Any:
        size = camera.height, camera.width
        maps = {"color": (*size, 3), "depth": size, "alpha": size, "variance": (*size, 3)}
        values = {"color": 0.45, "depth": 2.0, "alpha": 1.0, "variance": 0.01}
        return SimpleNamespace(**{name: torch.full(shape, values[name]) for name, shape in maps.items()})


def test_full_resolution_has_its_own_scores(run: RunFolder) -> None:
    config = replace(CONFIG, input=InputConfig(width=24, max_depth_m=4.0, crop_px=2))
    (run.path / "config.json").write_text(json.dumps(config.to_dict()))
    source = WithViews(truth_of(), NovelViews(truth_of()))
    metrics = score(run, source, renderer=Gray(), full_resolution=True)
    full = metrics["full_resolution"]
    assert (full["width"], full["height"]) == (40, 28), "the edge of 2 pixels of 24 is one of 4 pixels of 48"
    inner = [picture(i)[4:-4, 4:-4] for i in range(0, FRAMES, 4)]
    expected = np.mean([-10 * np.log10(((image.astype(float) - 0.45) ** 2).mean()) for image in inner])
    assert full["training"]["psnr_image_db"] == pytest.approx(expected, abs=1e-4)
    assert full["held_out"]["views"] == 15 and full["test_views"]["views"] == FRAMES - 1
    assert metrics["training"]["psnr_image_db"] > expected + 2, "at half the size noise is averaged"
    assert full["training_submaps"] is None and "uncertainty" not in full
    page = (run.path / "report.html").read_text()
    assert "Rendered images, full resolution: 40 × 28" in page
    assert score(run, source, renderer=Gray())["full_resolution"] is None
    assert "full resolution" not in (run.path / "report.html").read_text()


@pytest.mark.parametrize("width, scored", [(0, None), (24, None), (36, 30), (8192, 40), (999, 40)])
def test_a_map_refined_on_larger_images_is_scored_at_their_size_too(
    run: RunFolder, width: int, scored: int | None
) -> None:
    final = replace(CONFIG.final, iterations=10, width=width)
    config = replace(CONFIG, input=InputConfig(width=24, max_depth_m=4.0, crop_px=2), final=final)
    (run.path / "config.json").write_text(json.dumps(config.to_dict()))
    full = score(run, WithViews(truth_of(), NovelViews(truth_of())), renderer=Gray())["full_resolution"]
    assert full == scored if scored is None else full["width"] == scored


def test_lpips_is_scored_with_its_weights_only(run: RunFolder, tmp_path: Path) -> None:
    write_weights(tmp_path / "weights")
    lpips = Lpips.load(tmp_path / "weights")
    metrics = score(run, HandMade(None), renderer=Gray(), lpips=lpips)
    gray = np.full((36, 48, 3), 0.45, np.float32)
    expected = np.mean([lpips.distance(gray, picture(i)) for i in range(0, FRAMES, 4)])
    assert metrics["training"]["lpips"] == pytest.approx(expected) and metrics["lpips_network"] == "alex"
    assert "LPIPS (alex)" in (run.path / "report.html").read_text()
    without = score(run, HandMade(None), renderer=Gray())
    assert without["training"]["lpips"] is without["lpips_network"] is None
    assert "LPIPS (no weights)" in (run.path / "report.html").read_text()
    assert metrics["training"]["ms_ssim"] is None, "five scales need 161 pixels"
