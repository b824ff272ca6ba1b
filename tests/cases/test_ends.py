"""A bad end of a run looks bad: lost frames, a wrong scale; and the path of a phone is never called truth."""

import json
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from command_line import exit_code
from layouts import opengl, save, save_text, tum_line
from recordings import metadata, r3d_members, scene, write_stray, write_zip
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError
from sigmasplat.plugins.batch.batch import Executor
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.batch.make_run import make_run
from sigmasplat.plugins.evaluation.failure import scale_to_truth
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.terminal import Screen
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
SHORT = ("--set", "final.iterations=0", "--set", "input.width=0")
PRAISE = ("very close", "good", "PSNR", "ATE", "error of the path")


def write(folder: Path, frames: int = 12, units: int = 1000, shown: int | None = None, lists: bool = False) -> Path:
    """Write the start of the synthetic walk without the unit of depth: as TUM lists with the true path, or as a plain
    folder; the lens is covered from image number `shown` on."""
    room = open_source("synthetic:frames=60,width=64,height=48", limit=frames)
    truth, c = room.truth(), room.camera
    for n in range(frames):
        frame = room.frame(n)
        seen = n < (frames if shown is None else shown)
        color, depth = np.rint(frame.color * 255) * seen, np.rint(frame.depth_m * units) * seen
        save(folder / f"{'rgb' if lists else 'color'}/{n:02}.png", color.astype(np.uint8))
        save(folder / f"depth/{n:02}.png", depth.astype(np.uint16))
    for name in ("rgb", "depth") if lists else ():
        save_text(folder / f"{name}.txt", "".join(f"{n / 30:.6f} {name}/{n:02}.png\n" for n in range(frames)))
    save_text(folder / "calibration.json", json.dumps({"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}))
    poses = (tum_line(n / 30, T) for n, T in enumerate(truth.T_world_camera[:frames]))
    save_text(folder / "groundtruth.txt", "".join(poses))
    return folder


def write_phone(folder: Path) -> Path:
    """Write the same walk with poses that a program has estimated, in transforms.json."""
    write(folder)
    fields = json.loads((folder / "calibration.json").read_text())
    fields = {{"fx": "fl_x", "fy": "fl_y"}.get(name, name): value for name, value in fields.items()}
    truth = open_source("synthetic:frames=60,width=64,height=48").truth()
    named = [
        {"file_path": f"color/{n:02}.png", "depth_file_path": f"depth/{n:02}.png", "transform_matrix": opengl(T)}
        for n, T in enumerate(truth.T_world_camera[:12])
    ]
    for name in ("groundtruth.txt", "calibration.json"):
        (folder / name).unlink()
    save_text(folder / "transforms.json", json.dumps(fields | {"w": 64, "h": 48, "frames": named}))
    return folder


def command(said: str) -> list[str]:
    """Return the first command that the end of a run names."""
    line = next(line for line in said.splitlines() if line.startswith("next: sigmasplat "))
    return shlex.split(line)[2:]


def test_a_run_that_lost_its_images_ends_with_the_cause_and_a_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rec = write(tmp_path / "my rec", shown=3)
    assert exit_code("run", str(rec), "--out", "lost", *SHORT) == 0
    said = capsys.readouterr().out
    assert "FAILED: 9 of 12 images have no pose in the map (3–11). Likely cause: " in said
    assert "Assumed: " in said and "--depth-scale " in said
    assert not [words for words in PRAISE if words in said.partition("evaluation")[2]], said
    metrics, page = RunFolder.open(tmp_path / "lost").read_metrics(), (tmp_path / "lost/report.html").read_text()
    assert metrics["failure"].startswith("9 of 12") and "<p class=alarm>FAILED: 9 of 12" in page
    assert not [words for words in PRAISE[:1] if words in page.lower()]
    assert command(said)[0] == "inspect" and exit_code(*command(said)) in (0, 1)
    assert "frames" in capsys.readouterr().out
    assert exit_code("run", str(rec), "--no-eval", "--out", "unscored", *SHORT) == 0
    said = capsys.readouterr().out
    assert "FAILED: 9 of 12 images" in said and command(said)[0] == "inspect"


def test_a_run_that_lost_few_images_is_no_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rec = write(tmp_path / "rec", shown=9)
    assert exit_code("run", str(rec), "--out", str(tmp_path / "run"), *SHORT) == 0
    said, metrics = capsys.readouterr().out, RunFolder.open(tmp_path / "run").read_metrics()
    assert "3 of 12 images have no pose" in said and "FAILED" not in said and metrics["failure"] == ""


def made(executor: Executor, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, str | None]]:
    """Make runs without a process of their own, which costs more than a tiny run."""
    for job in jobs:
        try:
            make_run(job, out / job.name, executor.data, executor.save_every_s)
            yield job, None
        except RunError as problem:
            yield job, str(problem)


@pytest.mark.slow
def test_a_batch_counts_a_lost_run_as_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    good, bad = write(tmp_path / "good"), write(tmp_path / "bad", shown=2)
    monkeypatch.setattr(Executor, "make", made)
    words = ["batch", str(good), str(bad), "--out", str(tmp_path / "out"), "--set", "final.iterations=0"]
    assert exit_code(*words) == 1
    said = capsys.readouterr().out
    assert "bad failed: 10 of 12 images have no pose" in said and "1 of 2 runs" in said
    row = next(line for line in said.splitlines() if "│ bad" in line)
    assert "failed" in row and "│ good" in said


@pytest.mark.parametrize(
    ("lists", "units", "words", "remedy"),
    [
        (True, 1000, "5.0 times too small: the depth unit is probably wrong (assumed 5000 per metre", "1000"),
        (False, 2000, "2.0 times too large: depth or the focal length is probably wrong (assumed 1000 per", "2000"),
    ],
)
def test_a_wrong_unit_of_depth_is_named_where_there_is_truth(
    lists: bool, units: int, words: str, remedy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rec, more = write(tmp_path / "rec", 20, units, lists=lists), ("--set", "input.max_depth_m=30")
    assert exit_code("run", str(rec), "--out", str(tmp_path / "wrong"), *SHORT, *more) == 0
    said = capsys.readouterr().out
    assert f"the path is {words}" in said and f"--depth-scale {remedy}" in said
    assert "the path is " in (tmp_path / "wrong/report.html").read_text().partition("<div class=judged>")[0]
    again = command(said)
    assert again[0] == "run" and exit_code(*again, "--out", str(tmp_path / "right")) == 0
    assert "WRONG SCALE" not in capsys.readouterr().out
    scale = RunFolder.open(tmp_path / "right").read_metrics()["scale_to_truth"]
    assert scale == pytest.approx(1.0, abs=0.05)


def test_a_scale_is_only_told_where_the_path_determines_it() -> None:
    rng, times_s = np.random.default_rng(0), np.arange(40) / 30
    truth, still = (Trajectory(times_s, np.tile(np.eye(4), (40, 1, 1))) for _ in range(2))
    truth.T_world_camera[:, :3, 3] = np.cumsum(rng.normal(0, 0.1, (40, 3)), 0)
    estimate = Trajectory(times_s, truth.T_world_camera.copy())
    estimate.T_world_camera[:, :3, 3] *= 0.5
    assert scale_to_truth(estimate, truth) == pytest.approx(2.0)
    assert scale_to_truth(estimate.at(np.arange(5)), truth) is None
    estimate.T_world_camera[:, :3, 3] = rng.normal(0, 0.3, (40, 3))
    assert scale_to_truth(estimate, truth) is None and scale_to_truth(estimate, still) is None


def test_the_path_of_a_device_is_never_called_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rec = write_phone(tmp_path / "phone")
    exit_code("inspect", str(rec), "--json", "found.json")
    row = json.loads(Path("found.json").read_text())["found"]["poses"]
    assert row.startswith("12 poses of the device (transforms.json), ") and row.endswith("use them: --poses recorded")
    assert "not a ground truth" in row
    capsys.readouterr()
    assert exit_code("run", str(rec), "--out", "run", *SHORT) == 0
    said, run = capsys.readouterr().out, RunFolder.open(tmp_path / "run")
    page, metrics = (run.path / "report.html").read_text(), run.read_metrics()
    for text in (said, page):
        assert "RMS difference to the path of the device (transforms.json) is" in text
        assert not [words for words in ("true path", "ATE RMSE", "ATE rmse", "error of the path") if words in text]
    assert "--poses recorded" in said and not (run.path / "truth.txt").exists()
    assert metrics["ate"] is None and metrics["device_path"]["rmse_m"] < 0.05 and metrics["failures"] is None
    assert exit_code("run", str(rec), "--poses", "recorded", "--out", "posed", *SHORT) == 0


def test_phones_say_whose_path_they_have(tmp_path: Path) -> None:
    seen = scene()
    write_zip(tmp_path / "walk.r3d", r3d_members(seen, **metadata(seen)))
    write_stray(tmp_path / "stray", seen)
    for path in ("walk.r3d", "stray"):
        described = open_source(tmp_path / path, stride=2).described_truth()
        assert described is not None and "poses of the device (ARKit)" in described and "true" not in described


def test_an_alarm_is_red_on_a_terminal_and_plain_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen(Console(force_terminal=True, color_system="standard", markup=False, highlight=False), None)
    screen.next_commands(["view"], alarms={"FAILED: all": ["inspect"]})
    said = capsys.readouterr().out
    assert "\x1b[1;31mFAILED: all" in said and "inspect" in said and "view" not in said
    Screen().next_commands(["view"], alarms={"FAILED: all": []})
    assert capsys.readouterr().out.splitlines() == ["FAILED: all", "next: view"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "words"),
    [
        (
            "03-tum-lists-mm",
            "the path is 5.0 times too small: the depth unit is probably wrong (assumed 5000 per metre",
        ),
    ],
)
def test_the_handed_cases_end_as_they_should(
    case: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if not (CASES / case).is_dir():
        pytest.skip(f"no {CASES / case}")
    assert exit_code("run", str(CASES / case / "rec"), "--out", str(tmp_path / "run"), "--final-seconds", "1") == 0
    assert words in capsys.readouterr().out
