"""benchmarks/robustness.py: each disturbance does what its name says, and runs are scored as documented."""

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmark_results import laid_out
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.trajectory import write_trajectory

disturbances, recordings, scores, robustness, tables = map(
    importlib.import_module,
    ("disturbances", "disturbed_recordings", "robustness_scores", "robustness", "robustness_tables"),
)
SIZE = (48, 64)
RNG = np.random.default_rng(5)
COLOR = RNG.integers(0, 256, (*SIZE, 3), np.uint8)
DEPTH = np.where(np.arange(SIZE[1]) < 32, 1.0, 2.0).astype(np.float32) * np.ones((SIZE[0], 1), np.float32)


def changed(name: str, severity: int, index: int | None = None, seed: int = 3) -> tuple[Any, Any]:
    """Return the frame as a disturbance leaves it, by default in the middle of the event."""
    planned = disturbances.plan(name, severity, seed, 60, 300)
    middle = (planned.begin + planned.end) // 2
    at = middle if index is None else index
    return disturbances.disturbed(name, severity, seed, planned, at, COLOR, DEPTH, lambda share: 1.0 + share)


# ---- disturbances ----


@pytest.mark.parametrize("name", disturbances.DISTURBANCES)
def test_a_disturbance_depends_on_its_seed_only_and_leaves_the_original_alone(name: str) -> None:
    disturbance, color, depth = disturbances.DISTURBANCES[name], COLOR.copy(), DEPTH.copy()
    assert len(disturbance.labels) == len(disturbance.levels)
    assert len(disturbance.event_frames) in (0, len(disturbance.levels))
    for severity in range(1, len(disturbance.levels) + 1):
        first, again = changed(name, severity), changed(name, severity)
        for one, other, before in zip(first, again, (COLOR, DEPTH), strict=True):
            assert one.dtype == before.dtype and one.shape == before.shape
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(COLOR, color)
    np.testing.assert_array_equal(DEPTH, depth)


@pytest.mark.parametrize("name", [n for n, d in disturbances.DISTURBANCES.items() if d.event_frames])
def test_frames_outside_an_event_are_not_changed(name: str) -> None:
    planned = disturbances.plan(name, 3, 3, 60, 300)
    assert 0 < planned.begin < planned.end < len(planned)
    for index in (planned.begin - 1, planned.end):
        color, depth = changed(name, 3, index)
        np.testing.assert_array_equal(color, COLOR)
        np.testing.assert_array_equal(depth, DEPTH)


@pytest.mark.parametrize(("name", "severity", "share"), [
    ("missing", 1, 0.25), ("missing", 2, 0.5), ("missing", 3, 0.75), ("missing-90", 2, 0.9),
    ("black", 1, 1.0), ("kidnapped", 1, 1.0), ("range-clip", 1, 0.5), ("clean", 1, 0.0),
])  # fmt: skip
def test_readings_are_missing_in_the_share_that_is_named(name: str, severity: int, share: float) -> None:
    color, depth = changed(name, severity)
    assert np.mean(depth == 0) == pytest.approx(share, abs=0.03)
    assert set(np.unique(depth)) <= {0.0, 1.0, 2.0}
    assert (color == 0).all() == (name in ("black", "kidnapped"))


def test_noise_has_the_deviation_that_is_named() -> None:
    _, depth = changed("depth-noise", 3)
    error = depth - DEPTH
    assert error[:, :32].std() == pytest.approx(0.02, rel=0.1) and error[:, 32:].std() == pytest.approx(0.08, rel=0.1)
    grey = np.full_like(COLOR, 128)
    planned = disturbances.plan("color-noise", 2, 0, 60, 300)
    color, _ = disturbances.disturbed("color-noise", 2, 0, planned, 7, grey, DEPTH, lambda share: 1.0)
    assert (color / 255.0 - 128 / 255).std() == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(("severity", "width"), [(1, 1), (2, 3), (3, 5)])
def test_readings_are_eroded_beside_a_depth_edge_only(severity: int, width: int) -> None:
    _, depth = changed("edge-erosion", severity)
    touched = (depth != DEPTH).any(0)
    assert touched[32 - width : 32 + width].all() and not touched[: 30 - width].any()
    assert not touched[34 + width :].any()
    band = depth[:, 32 - width : 32 + width]
    assert (band == 0).any() and ((band > 1) & (band < 2)).any()


def test_blur_keeps_the_mean_and_removes_detail() -> None:
    deviations = [changed("blur", severity)[0].std() for severity in (1, 2, 3)]
    assert COLOR.std() > deviations[0] > deviations[1] > deviations[2]
    assert changed("blur", 3)[0].mean() == pytest.approx(COLOR.mean(), rel=0.03)


def test_brightness_jumps_and_changes_in_turns() -> None:
    begin = disturbances.plan("brightness", 2, 3, 60, 300).begin
    assert changed("brightness", 2, begin)[0].mean() == pytest.approx(0.4 * COLOR.mean(), rel=0.02)
    dark, bright = (changed("brightness", 3, begin + since)[0].mean() for since in (0, 5))
    assert dark < 0.5 * COLOR.mean() and bright > 1.15 * COLOR.mean()  # bright pixels are clipped at 255


def test_an_object_covers_its_share_of_the_image_moves_and_is_nearer_than_the_scene() -> None:
    planned = disturbances.plan("moving-object", 2, 3, 60, 300)
    covered = [changed("moving-object", 2, i)[1] < 1 for i in range(planned.begin, planned.end)]
    assert covered[len(covered) // 2].mean() == pytest.approx(0.3, abs=0.03)
    columns = [np.flatnonzero(mask.any(0)).mean() for mask in covered if mask.any()]
    assert columns == sorted(columns) and columns[-1] - columns[0] > SIZE[1] / 2


# ---- the order of frames ----


@pytest.mark.parametrize(("severity", "step"), [(1, 2), (2, 4), (3, 8)])
def test_a_faster_camera_skips_frames(severity: int, step: int) -> None:
    planned = disturbances.plan("speed", severity, 0, 60, 200)
    np.testing.assert_array_equal(planned.color, planned.depth)
    assert set(np.diff(planned.color)) == {step} and planned.color[-1] < 200
    assert len(planned) == min(60, 200 // step)


def test_late_depth_stands_still_and_shows_earlier_frames_from_then_on() -> None:
    planned = disturbances.plan("desync", 3, 0, 60, 200)
    assert planned.end - planned.begin == 10 and set(np.diff(planned.color)) == {1}
    late = planned.color - planned.depth
    assert not late[: planned.begin].any() and set(late[planned.end :]) == {10}
    assert set(planned.depth[planned.begin : planned.end]) == {planned.begin}


def test_a_kidnapped_camera_is_uncovered_elsewhere_and_comes_back() -> None:
    planned = disturbances.plan("kidnapped", 2, 1, 60, 300)
    before, after = planned.color[: planned.end], planned.color[planned.end :]
    np.testing.assert_array_equal(before, np.arange(planned.end))
    assert planned.end - planned.begin == 15 and after[0] == planned.end + 60
    assert set(np.diff(after)) == {-1} and 0 < after[-1] < planned.begin


def test_events_begin_where_the_seed_says_and_leave_frames_to_recover() -> None:
    plans = [disturbances.plan("black", 3, seed, 60, 300) for seed in range(8)]
    assert len({planned.begin for planned in plans}) > 2
    assert all(planned.end - planned.begin == 40 and len(planned) - planned.end >= 30 for planned in plans)
    with pytest.raises(ValueError, match=r"40 frames are too few for black, severity 3"):
        disturbances.plan("black", 3, 0, 60, 40)


def test_a_recording_is_written_without_truth_and_read_back(tmp_path: Path) -> None:
    path = "synthetic:frames=8,width=64,height=48"
    original = recordings.original(path, 0.0, tmp_path / "frames")
    again = recordings.original(path, 0.0, tmp_path / "frames")
    planned = disturbances.plan("speed", 1, 0, 3, len(original))
    recordings.write(again, planned, "speed", 1, 0, tmp_path / "recording")
    read = open_source(str(tmp_path / "recording"))
    source = open_source(path)
    assert len(read) == 3 and read.truth() is None and read.camera == original.camera
    for index in range(3):
        frame, wanted = read.frame(index), source.frame(2 * index)
        np.testing.assert_array_equal(frame.color, wanted.color)
        np.testing.assert_allclose(frame.depth_m, wanted.depth_m, atol=1.1e-4)
        assert frame.timestamp_s == pytest.approx(index / 30, abs=1e-5)
    np.testing.assert_array_equal(original.T_world_camera, source.truth().T_world_camera)  # type: ignore[union-attr]


def recorded(folder: Path, frames: int, without_truth: set[int] = frozenset()) -> Path:  # type: ignore[assignment]
    """Write a recording with truth, in which some frames have no true pose."""
    original = recordings.original(f"synthetic:frames={frames},width=64,height=48", 0.0, folder / "frames")
    recordings.write(original, disturbances.plan("clean", 1, 0, frames, frames), "clean", 1, 0, folder / "recording")
    known = [i for i in range(frames) if i not in without_truth]
    path = Trajectory(np.array(known) / recordings.FRAMES_PER_SECOND, original.T_world_camera[known])
    write_trajectory(folder / "recording" / "groundtruth.txt", path)
    return folder / "recording"


def test_frames_without_a_true_pose_are_left_out(tmp_path: Path) -> None:
    path = recorded(tmp_path, 6, {2})
    original = recordings.original(str(path), 0.0, tmp_path / "decoded")
    assert len(original) == len(original.T_world_camera) == 5 and original.frames.tolist() == [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(original.color_of(2), original.color[3])
    recordings.write(original, disturbances.plan("clean", 1, 0, 6, 5), "clean", 1, 0, tmp_path / "again")
    read, source = open_source(str(tmp_path / "again")), open_source(str(path))
    assert len(read) == 5
    np.testing.assert_array_equal(read.frame(2).color, source.frame(3).color)


def test_rows_that_a_recording_is_too_short_for_are_left_out_before_anything_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(tmp_path, 8, {7})
    chosen = robustness.Options((str(path),), ("black", "clean"), (1, 2), seeds=(0,), frames=7, runs=tmp_path / "runs")
    kept, left_out = robustness.possible(robustness.jobs_of(chosen))
    assert [job.stem for job in kept] == ["recording-clean-1-seed0"]
    assert left_out == ["recording: 1 of 8 frames, which have no true pose"] + [
        f"recording-black-{severity}-seed0: 7 frames are too few for black, severity {severity}, with 7 frames"
        for severity in (1, 2)
    ]
    monkeypatch.setattr(robustness, "original", lambda *_: pytest.fail("an image was decoded"))
    none = replace(chosen, disturbances=("black",), severities=(2, 3), out=tmp_path / "results")
    assert robustness.main(none) == 2 and "nothing can be run: recording: 1 of 8" in capsys.readouterr().err
    figures = {"measured": "abc", "p_off": None, "runs": [run_of("clean", 1, 0)], "left_out": left_out}
    assert "Left out: recording: 1 of 8 frames" in laid_out("robustness", figures)["Suite"].note


# ---- scores ----


def walk(frames: int) -> NDArray[np.float64]:
    """Return poses T_world_camera of a camera that moves 3 cm and turns 1° a frame."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for i in range(frames):
        angle = np.radians(i)
        poses[i, :3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        poses[i, :3, 3] = 0.03 * i, 0.01 * np.sin(i), 0
    return poses


def run_folder(
    folder: Path, poses: NDArray[np.float64], lost: set[int], leave_out: bool = False, **columns: Any
) -> Path:
    """Write log.jsonl and trajectory.txt as a run does; with `leave_out`, lost frames are not in trajectory.txt."""
    lines = [
        {"index": i, "lost": i in lost, "is_keyframe": i == 0, "tracking": {"agreement": 0.5, "how": "text"},
         "T_world_camera": poses[i].tolist()} | {name: column[i] for name, column in columns.items()}
        for i in range(len(poses))
    ]  # fmt: skip
    folder.mkdir(exist_ok=True)
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    rows = [i for i in range(len(poses)) if not (leave_out and i in lost)]
    write_trajectory(folder / "trajectory.txt", Trajectory(np.array(rows) / 30, poses[rows]))
    return folder


PLAN = disturbances.Plan(np.arange(40), np.arange(40), 12, 18)
TRUTH = walk(40)[None]
MOVED = np.array([[0, 0, 1, 0.5], [0, 1, 0, -2], [-1, 0, 0, 3], [0, 0, 0, 1]], float)


def scored(folder: Path, poses: NDArray[np.float64], lost: set[int], **more: Any) -> dict[str, Any]:
    """Return the score of a run whose world differs from that of the truth."""
    run = scores.read_run(run_folder(folder, MOVED @ poses, lost, **more), len(poses))
    found: dict[str, Any] = scores.score(run, TRUTH, PLAN)
    return found


def test_a_right_path_has_no_failure(tmp_path: Path) -> None:
    found = scored(tmp_path, TRUTH[0], set())
    assert found["ate_m"] == pytest.approx(0, abs=1e-6) and found["silent"] == found["lost"] == 0
    assert found["believed"] == 40 and found["silent_in_a_row"] == 0 and found["recovery"] == 0


@pytest.mark.parametrize("leave_out", [True, False])
def test_wrong_frames_are_silent_only_if_they_are_valid(tmp_path: Path, leave_out: bool) -> None:
    poses, lost = TRUTH[0].copy(), set(range(14, 22))
    poses[14:30, 1, 3] += 0.3
    found = scored(tmp_path, poses, lost, leave_out=leave_out)
    assert found["lost"] == 8 and found["believed"] == 32 and found["silent"] == 8
    assert found["event"] == [12, 18] and found["outside"] == 34 and found["missed_outside"] == 4
    assert found["silent_in_a_row"] == 8 and found["recovery"] == 12
    assert found["ate_m"] > 0.05


def test_a_wrong_second_half_does_not_move_the_world(tmp_path: Path) -> None:
    poses = TRUTH[0].copy()
    poses[18:, 1, 3] += 5.0
    found = scored(tmp_path, poses, set())
    assert found["silent"] == 22 and found["recovery"] is None and found["recovery_known"] is None


def test_a_component_that_joined_later_is_valid_at_the_end(tmp_path: Path) -> None:
    state = ["tracked"] * 20 + ["apart"] * 15 + ["relocalised"] * 5
    found = scored(tmp_path, TRUTH[0], set(), state=state)  # trajectory.txt has all frames
    assert found["believed"] == 40 and found["lost"] == found["silent"] == found["missed_outside"] == 0


def test_a_known_view_is_near_one_before_the_event() -> None:
    back = np.concatenate([np.arange(18), np.arange(38, 6, -1)])
    truth = TRUTH[:, back]
    known = scores.known_views(truth, 12, 18)
    assert not known[:18].any() and not known[18] and known[-1]
    turned = truth.copy()
    turned[:, 18:, :3, :3] = turned[:, 18:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert not scores.known_views(turned, 12, 18).any()


def test_a_pose_of_colour_or_of_late_depth_is_right(tmp_path: Path) -> None:
    late = TRUTH[0, np.maximum(np.arange(40) - 6, np.minimum(np.arange(40), 12))]
    both = np.stack([TRUTH[0], late])
    for path in both:
        run = scores.read_run(run_folder(tmp_path, MOVED @ path, set()), 40)
        assert scores.score(run, both, PLAN)["silent"] == 0
    assert scores.score(run, TRUTH, PLAN)["silent"] > 20


def test_pairs_have_every_frame_with_a_pose(tmp_path: Path) -> None:
    poses = TRUTH[0].copy()
    poses[30:35, 1, 3] += 0.07
    p_off = [None, *(i / 40 for i in range(1, 40))]
    run = scores.read_run(run_folder(tmp_path, poses, {33}, p_off=p_off), 40)
    pairs = scores.pairs(run, TRUTH, PLAN)
    assert len(pairs) == 39 and [i for i, (_, off) in enumerate(pairs, 1) if off] == [30, 31, 32, 33, 34]
    assert scores.pairs(scores.read_run(run_folder(tmp_path, poses, {33}), 40), TRUTH, PLAN) == []


def test_kept_arrays_have_values_and_errors_of_each_frame(tmp_path: Path) -> None:
    poses = TRUTH[0].copy()
    poses[30, 1, 3] += 0.25
    run = scores.read_run(run_folder(tmp_path, poses, {5}), 40)
    kept = scores.arrays(run, TRUTH, PLAN)
    assert kept["error_tracked_m"][30] == pytest.approx(0.25, abs=1e-6) and kept["lost"].sum() == 1
    assert (kept["tracking_agreement"] == 0.5).all() and np.isnan(kept["tracking_how"]).all()


def test_auroc_brier_and_calibration_by_hand() -> None:
    p, off = np.array([0.1, 0.4, 0.35, 0.8]), np.array([False, False, True, True])
    assert scores.auroc(p, off) == pytest.approx(0.75)  # 3 of 4 pairs are in the right order
    assert scores.auroc(np.full(4, 0.5), off) == pytest.approx(0.5)
    assert scores.auroc(p, np.zeros(4, bool)) is None
    found = scores.probability_scores(list(zip(p, off, strict=True)))
    assert found["brier"] == pytest.approx((0.01 + 0.16 + 0.65**2 + 0.04) / 4) and found["off"] == 2
    assert [part["frames"] for part in found["calibration"]] == [1, 1, 1, 1]
    assert [part["off"] for part in found["calibration"]] == [0.0, 1.0, 0.0, 1.0]
    assert scores.probability_scores([]) is None


# ---- the program and its tables ----


def test_jobs_are_all_combinations_and_unknown_names_are_refused(tmp_path: Path) -> None:
    jobs = robustness.jobs_of(robustness.Options(("room",), ("clean", "black"), seeds=(0, 7), command="other --fast"))
    assert [(job.disturbance, job.severity, job.seed) for job in jobs] == [
        (name, severity, seed)
        for seed in (0, 7)
        for name, severity in (("clean", 1), *(("black", s) for s in (1, 2, 3)))
    ]
    words = jobs[0].words(Path("in"), Path("out"))
    assert words[:4] == ["other", "--fast", "run", "in"] and "input.width=240" in words
    for wrong in ({"disturbances": ("fog",)}, {"severities": (4,)}):
        assert robustness.main(robustness.Options(runs=tmp_path, out=tmp_path, **wrong)) == 2
    assert not list(tmp_path.iterdir())


def test_a_failed_run_is_a_problem_and_is_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = robustness.Options(
        ("synthetic:frames=8,width=64,height=48",), ("clean",), seeds=(0,), frames=4, command="false", runs=tmp_path,
        out=tmp_path / "results",
    )  # fmt: skip
    for _ in range(2):
        assert robustness.main(options) == 1
        assert "[1/1] " in capsys.readouterr().err
    assert robustness.main(replace(options, collect=True)) == 1
    assert "[1/1] " not in capsys.readouterr().err
    (path,) = (tmp_path / "results").glob("*.json")
    assert "exit code 1" in json.loads(path.read_text())["figures"]["runs"][0]["problem"]


def test_a_finished_run_is_scored_once_and_its_recording_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = "synthetic:frames=8,width=64,height=48"
    called = []

    def call(words: list[str], other: bool) -> None:
        recording, out = Path(words[words.index("run") + 1]), Path(words[words.index("--out") + 1])
        called.append(recording)
        assert not other and {file.name for file in recording.iterdir()} == {
            "rgb", "depth", "rgb.txt", "depth.txt", "calibration.json",
        }  # fmt: skip
        run_folder(out, MOVED @ recordings.original(path, 0.0, tmp_path / "frames").T_world_camera[:5], {2})
        (out / "run.json").write_text(json.dumps({"code": "abc"}))

    monkeypatch.setattr(robustness, "call", call)
    options = robustness.Options(
        (path,),
        ("missing",),
        (1,),
        seeds=(0,),
        frames=5,
        runs=tmp_path,
        out=tmp_path / "results",
        keep=tmp_path / "kept",
    )
    assert robustness.main(options) == robustness.main(options) == 0
    assert len(called) == 1 and not called[0].parent.exists()
    (job,) = robustness.jobs_of(options)
    result = robustness.earlier(job, tmp_path / "robustness")
    assert result["code"] == "abc" and result["figures"]["lost"] == 1 and result["figures"]["frames"] == 5
    assert len(list((tmp_path / "kept").iterdir())) == 2
    assert "| depth missing at random | 25 % |" in capsys.readouterr().out


def run_of(disturbance: str, severity: int, seed: int, **figures: Any) -> dict[str, Any]:
    plain = {"frames": 80, "lost": 0, "believed": 80, "silent": 0, "silent_in_a_row": 0, "ate_m": 0.01, "outside": 80,
             "missed_outside": 0, "event": None, "recovery": None, "known": None, "recovery_known": None}  # fmt: skip
    job = {"sequence": "room", "disturbance": disturbance, "severity": severity, "seed": seed, "problem": None}
    return job | plain | figures


EVENT = {"event": [30, 50], "known": 6}
RUNS = [
    run_of("clean", 1, 0),
    run_of("kidnapped", 3, 0, **EVENT, recovery=8, recovery_known=2, valid=50, ate_m=0.012),
    run_of("kidnapped", 3, 1, **EVENT, valid=40, silent=8, silent_in_a_row=8, ate_m=0.03, missed_outside=41),
    {"sequence": "room", "disturbance": "black", "severity": 1, "seed": 0, "problem": "out of | memory"},
]
P_OFF = scores.probability_scores([(0.9, True), (0.2, False), (0.1, False)])


def test_tables_show_each_disturbance_and_the_suite() -> None:
    made = laid_out("robustness", {"measured": "a" * 40, "runs": RUNS, "p_off": P_OFF})
    assert list(made) == ["Suite", "room", "Calibration of p_off", "Goals", "Failed"]
    suite = {row[0]: row[1:] for row in made["Suite"].rows}
    assert suite["runs"] == ["3", "3"] and suite["silent failures, % of frames"] == ["3.3", "3.3"]
    # Two of three: the third has an ATE below 5 cm, but lost more than half of the frames outside its event.
    assert suite["runs with ATE < 2 cm, %"][0] == suite["runs with ATE < 5 cm, %"][0] == "66.7"
    assert suite["AUROC of p_off"][0] == "1.00"
    kidnapped = next(row for row in made["room"].rows if row[0].startswith("kidnapped"))
    assert (
        made["room"].rows[0][-2:] == ["–", "–"]
        and kidnapped[1] == "20 + 100"
        and kidnapped[-2:] == ["8 (1 of 2)", "2 (1 of 2)"]
    )
    goals = {row[0]: row[2] for row in made["Goals"].rows}
    assert goals["AUROC of p_off ≥ 0.9"] == "yes" and goals["silent failures ≤ 1 % of frames"] == "**no**"
    assert goals["kidnapped: a wrong pose is declared lost within 3 frames"] == "**no**"
    assert goals["kidnapped: found within 10 frames of a known view"] == "**no**"
    assert made["Failed"].rows == [["room, black 1, seed 0", "out of / memory"]]
