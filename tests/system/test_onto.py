"""`sigmasplat run --onto`: a recording of another day continues the map of an earlier run."""

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from recorded_room import OPTIONS, mirrored, write_images
from sigmasplat.data import se3
from sigmasplat.data.submap import MemoryStore
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.viewer.snapshot_sources import finished_snapshot
from sigmasplat.run.finished_map import FinishedMap, continued, take_over
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.trajectory import write_trajectory

pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")

WALK = "synthetic:frames=200,width=160,height=120"
SHORT = ("--set", "mapping.first_iterations=30", "--set", "mapping.iterations=8", "--set", "final.iterations=5",
         "--set", "submaps.frames=12", "--set", "registration.iterations=3", "--set", "input.width=112")  # fmt: skip
FRAMES = 14
FIRST, SECOND = ("--limit", "24"), ("--start", "0.5", "--limit", str(FRAMES))
SECOND_BEGINS = 15
"""Number of the first frame of the second part in the walk."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run SLAM on two overlapping parts of one walk, the second onto the first."""
    folder = tmp_path_factory.mktemp("onto")
    first, second = str(folder / "first"), str(folder / "second")
    assert exit_code("run", WALK, *FIRST, "--out", first, "--no-eval", *SHORT) == 0
    assert exit_code("run", WALK, *SECOND, "--onto", first, "--out", second, "--no-eval", *SHORT) == 0
    return folder


def files(run: Path) -> dict[str, bytes]:
    return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_the_second_part_has_poses_in_the_first_world(place: Path) -> None:
    """Absolute poses are compared, without alignment."""
    truth = open_source(WALK).truth()
    assert truth is not None
    path = RunFolder(place / "second").read_trajectory()
    assert len(path) == FRAMES
    frames = SECOND_BEGINS + np.arange(FRAMES)
    expected = se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[frames]
    errors_m = np.linalg.norm((path.T_world_camera - expected)[:, :3, 3], axis=1)
    assert float(np.sqrt(np.mean(errors_m**2))) < 0.05


@pytest.mark.slow
def test_the_measured_unit_of_given_poses_is_kept(place: Path, tmp_path: Path) -> None:
    truth = open_source(WALK).truth()
    assert truth is not None
    halved = truth.T_world_camera.copy()
    halved[:, :3, 3] *= 0.5
    write_trajectory(tmp_path / "poses.txt", Trajectory(truth.timestamps_s, halved))
    words = ("--poses", str(tmp_path / "poses.txt"), "--set", "input.poses_scale=0", "--onto", str(place / "first"))
    assert exit_code("run", WALK, *SECOND, *words, "--out", str(tmp_path / "third"), "--no-eval", *SHORT) == 0
    assert RunFolder(tmp_path / "third").config().input.poses_scale == pytest.approx(2.0, rel=0.1)


def test_the_new_run_contains_the_old_submaps(place: Path) -> None:
    first, second = RunFolder(place / "first"), RunFolder(place / "second")
    count = len(first.submaps)
    assert second.facts()["onto"]["run"] == str(first.path.resolve()) and second.facts()["onto"]["submaps"] == count
    for index in range(count):
        old, new = first.submaps.load(index), second.submaps.load(index)
        assert new.field.params.equal(old.field.params) and new.camera == old.camera
        assert [frame - 24 for frame in old.frames] == list(new.frames) and max(new.frames) < 0
    assert min(second.read_log(), key=lambda line: line["index"])["submap"] == count
    old, new = (run.read_checkpoint()[0]["T_world_submap"].numpy() for run in (first, second))
    assert np.abs(new[:count] - old[:count]).max() < 1e-3
    assert len(second.read_map()) > len(first.read_map())


def test_readers_use_the_frames_of_the_new_session_only(place: Path) -> None:
    second = RunFolder(place / "second")
    reader = RunReader(second)
    found = [frame for frame, _ in reader.keyframes()]
    assert len(found) == reader.count_keyframes() and min(found) == 0 and max(found) < FRAMES
    snapshot = finished_snapshot(second)
    assert len(snapshot.path) == FRAMES


def test_the_earlier_run_is_not_changed(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = shutil.copytree(place / "first", tmp_path / "first")
    before = files(copy)
    asked = ("run", WALK, "--limit", "2", "--no-eval", "--onto", str(copy), *SHORT)
    assert exit_code(*asked, "--out", str(copy), "--overwrite") == 2
    told = capsys.readouterr().err
    assert "is the run that --onto continues" in told and told.count("\n") == 1
    assert exit_code(*asked, "--out", str(tmp_path / "second")) == 0
    assert files(copy) == before


def test_another_room_stays_apart(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = SyntheticRoom(frames=200, width=160, height=120, seed=1)
    recording = write_images(tmp_path / "mirrored", (mirrored(room.frame(i)) for i in range(0, 8)))
    out = tmp_path / "run"
    assert exit_code("run", str(recording), *OPTIONS, "--onto", str(place / "first"), "--out", str(out), *SHORT) == 0
    told = capsys.readouterr()
    assert (
        "8 of 8 images have no pose (0–7), of which 8 are in components/" in told.out and "never recognised" in told.err
    )
    run = RunFolder(out)
    assert len(run.read_trajectory()) == 0 and run.component_numbers() == [1]
    assert len(run.read_component(1).trajectory) == 8
    assert {line["state"] for line in run.read_log()} == {"apart"}
    assert "never recognised" in (out / "report.html").read_text()


def test_a_recording_that_is_recognised_later_joins_with_all_its_frames(place: Path) -> None:
    """The first images have too little contrast to be recognised, so the recording begins apart."""
    first = FinishedMap.of(RunFolder.open(place / "first"))
    store, room = MemoryStore(), SyntheticRoom(frames=200, width=160, height=120)
    take_over(first.store, first.members, first.frames, store)
    slam = continued(first.config, store, [first.anchors[index] for index in first.members])
    walked = range(8, 20)
    for i, frame in enumerate(room.frame(k) for k in walked):
        faint = np.float32(0.5) + np.float32(0.05) * (frame.color - np.float32(0.5))
        slam.step(replace(frame, index=i, color=faint if i < 4 else frame.color))
    assert slam.steps[0].state == slam.steps[5].state == "apart" and slam.steps[-1].state == "tracked"
    assert slam.valid().all() and set(slam.atlas.components) == {0}
    expected = se3.inverse(room.truth().T_world_camera[0]) @ room.truth().T_world_camera[list(walked)]
    assert np.linalg.norm((slam.trajectory().T_world_camera - expected)[:, :3, 3], axis=1).max() < 0.05


@pytest.mark.slow
def test_a_resumed_run_gives_the_same_bytes(place: Path, tmp_path: Path) -> None:
    asked = ["run", WALK, "--start", "0.5", "--limit", "14", "--onto", str(place / "first"), "--no-eval", *SHORT]
    assert exit_code(*asked, "--out", str(tmp_path / "whole")) == 0
    cut = tmp_path / "cut"
    assert killed([*asked, "--out", str(cut), "--save-every", "0.001"], cut / "log.jsonl", after=7) < 14
    assert exit_code("resume", str(cut), "--no-eval") == 0
    for name in ("trajectory.txt", "map.ply", "loops.json"):
        assert (cut / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def killed(arguments: list[str], log: Path, after: int) -> int:
    """Run in a separate process, kill it when `after` frames are logged, and return how many were logged."""
    process = subprocess.Popen([sys.executable, "-m", "sigmasplat.cli", *arguments], stdout=subprocess.DEVNULL)
    deadline_s = time.monotonic() + 90
    while not log.exists() or log.read_text().count("\n") < after:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.005)
    process.kill()
    process.wait()
    return log.read_text().count("\n")


@pytest.mark.parametrize(
    "given, words",
    [
        (["--set", "input.width=80"], "all submaps of a map have images of one size"),
        (["--fx", "400"], "sees less than half of the images of run"),
        (["--set", "recovery.relocalise=off"], "--set recovery.relocalise=on"),
        (["--preset", "varsplat-fast"], "--set recovery.relocalise=on"),
    ],
)
def test_a_refusal_is_one_line_and_leaves_no_folder(
    place: Path, tmp_path: Path, given: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write_images(tmp_path / "images", [SyntheticRoom(frames=200, width=160, height=120).frame(0)])
    calibration = ("--fx", "128", "--depth-scale", "1000")
    asked = ("run", str(recording), *calibration, "--onto", str(place / "first"), "--out", str(tmp_path / "run"))
    assert exit_code(*asked, *given) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_runs_without_a_finished_map_are_refused(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = RunFolder(tmp_path / "copy")
    copy.path.mkdir()
    for name in ("run.json", "config.json", "checkpoint.safetensors"):
        (copy.path / name).write_bytes((place / "first" / name).read_bytes())
    copy.note(status="interrupted")
    for words in ("is not complete (status: interrupted)", "kept no submaps"):
        assert exit_code("run", WALK, "--limit", "2", "--onto", str(copy.path), "--out", str(tmp_path / "new")) == 2
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1 and not (tmp_path / "new").exists()
        copy.note(status="complete")
