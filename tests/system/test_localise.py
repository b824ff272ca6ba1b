"""`sigmasplat localise`: images are found in the map of a finished run, or refused with a reason."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from recorded_room import OPTIONS, mirrored, write_images
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.run.finished_map import FinishedMap
from sigmasplat.run.localise import FOUND, NOT_FOUND, Localiser
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")

WALK = "synthetic:frames=200,width=160,height=120"
SHORT = ("--set", "mapping.first_iterations=30", "--set", "mapping.iterations=10", "--set", "final.iterations=5",
         "--set", "registration.iterations=3", "--set", "input.width=112")  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run SLAM on the first 28 frames of a walk."""
    folder = tmp_path_factory.mktemp("localise") / "run"
    assert exit_code("run", WALK, "--limit", "28", "--out", str(folder), "--no-eval", *SHORT) == 0
    return folder


@pytest.fixture(scope="module")
def localiser(run: Path) -> Localiser:
    finished = FinishedMap.of(RunFolder.open(run))
    return Localiser(finished, finished.config)


def true_pose(frame: int) -> np.ndarray:
    """Return T_world_camera of a frame; the world of the run is the first camera."""
    truth = open_source(WALK).truth()
    assert truth is not None
    return se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[frame]


def error_m(T_world_camera: np.ndarray, frame: int) -> float:
    return float(np.linalg.norm((T_world_camera - true_pose(frame))[:3, 3]))


def test_images_of_the_same_walk_are_found(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = tmp_path / "found.jsonl"
    asked = ("localise", WALK, "--in", str(run), "--stride", "7", "--limit", "4")
    assert exit_code(*asked, "--out", str(results)) == 0
    told = capsys.readouterr().out
    assert "4 of 4 images found" in told and "± " in told
    records = [json.loads(line) for line in results.read_text().splitlines()]
    for i, record in enumerate(records):
        assert record["verdict"] == FOUND and record["index"] == i and record["component"] == 0
        assert error_m(np.array(record["T_world_camera"]), 7 * i) < 0.05
        assert (np.linalg.eigvalsh(np.array(record["covariance"])) > 0).all()
    assert exit_code(*asked, "--out", str(tmp_path / "found.txt")) == 0
    path = read_poses(tmp_path / "found.txt")
    assert np.allclose(path.T_world_camera, [record["T_world_camera"] for record in records], atol=1e-6)


def test_the_error_of_the_map_is_a_part_of_the_covariance(localiser: Localiser) -> None:
    """At the first keyframe the map has no error; further away it has that of its path."""
    first, last = (localiser.locate(SyntheticRoom(frames=200, width=160, height=120).frame(i)) for i in (0, 24))
    assert localiser.errors is not None and first.covariance is not None and last.covariance is not None
    assert localiser.errors.of_keyframe(0, 0) == pytest.approx(np.zeros((6, 6)))
    of_map = localiser.errors.of_keyframe(last.submap, last.keyframe)
    assert np.trace(of_map[:3, :3]) > 1e-8 and (last.submap, last.keyframe) > (0, 0)
    moved = se3.adjoint(last.T_world_camera)
    in_world = moved @ last.covariance @ moved.T
    assert np.linalg.eigvalsh(in_world - of_map).min() > 0, "what is left is the error of the search"


def test_images_of_another_room_are_not_found(localiser: Localiser) -> None:
    """No room that was seen looks like its own mirror image."""
    for i in range(0, 40, 10):
        seen = SyntheticRoom(frames=200, width=160, height=120, seed=1).frame(i)
        result = localiser.locate(mirrored(seen))
        assert result.verdict == NOT_FOUND and result.reason and result.T_world_camera is None


def test_an_image_without_texture_is_refused_with_the_reason(localiser: Localiser) -> None:
    frame = open_source(WALK).frame(0)
    black = localiser.locate(replace(frame, color=np.zeros_like(frame.color)))
    blind = localiser.locate(replace(frame, depth_m=np.zeros_like(frame.depth_m)))
    for result in (black, blind):
        assert result.verdict == NOT_FOUND and "too little depth or texture" in result.reason


def test_images_of_another_camera_are_found(localiser: Localiser) -> None:
    """The other camera has more pixels, a longer focal length and another principal point."""
    camera = Camera(240, 200, 220.0, 215.0, 121.0, 97.0)
    for i in (10, 24):
        seen = SyntheticRoom(frames=200, width=480, height=360).frame(i).seen_by(camera)
        result = localiser.locate(seen)
        assert result.verdict == FOUND and result.T_world_camera is not None
        assert error_m(result.T_world_camera, i) < 0.05


def test_a_frame_seen_by_another_camera_has_the_same_surface() -> None:
    """Points of both frames lie on the same surface: here on a slanted plane, whose colour is the position on it."""
    large, small = Camera(64, 48, 60.0, 58.0, 31.0, 22.0), Camera(30, 26, 33.0, 32.0, 14.2, 13.1)

    def plane(camera: Camera) -> Frame:
        rays = camera.rays()
        depth = 1.0 / (0.5 + 0.2 * rays[..., 0] + 0.1 * rays[..., 1])
        color = np.stack([0.5 + 0.3 * rays[..., 0], 0.5 + 0.3 * rays[..., 1], np.full_like(depth, 0.5)], -1)
        return Frame(3, 0.5, color.astype(np.float32), depth.astype(np.float32), camera)

    moved, expected = plane(large).seen_by(small), plane(small)
    read = moved.depth_m > 0
    assert 0.8 < read.mean() <= 1.0 and small.share_seen_by(large) == pytest.approx(read.mean(), abs=0.1)
    assert np.abs(moved.depth_m - expected.depth_m)[read].max() < 0.02  # the nearest pixel is up to half a pixel off
    assert np.abs(moved.color - expected.color)[read].max() < 0.01
    assert moved.index == 3 and moved.camera == small


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--out", "found.csv"], "--out must end in .jsonl or .txt"),
        (["--fx", "400"], "sees less than half"),
        (["--set", "tracking.method=guess"], "tracking.method must be one of"),
    ],
)
def test_a_refusal_is_one_line(
    arguments: list[str], words: str, run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    recording = write_images(tmp_path / "images", [open_source(WALK).frame(0)])
    assert exit_code("localise", str(recording), "--in", str(run), *OPTIONS, *arguments) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


def test_runs_without_a_finished_map_are_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = RunFolder(tmp_path / "copy")
    copy.path.mkdir()
    for name in ("run.json", "config.json", "checkpoint.safetensors"):
        (copy.path / name).write_bytes((run / name).read_bytes())
    copy.note(status="interrupted")
    for words in ("is not complete (status: interrupted)", "kept no submaps"):
        assert exit_code("localise", WALK, "--in", str(copy.path)) == 2
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1
        copy.note(status="complete")
