"""Known camera poses: their files, the frames they belong to, and their unit."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import recordings
from command_line import exit_code
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.scale import for_scene
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.lists import FLIP_YZ
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.scene import measured_scale, open_scene, scale_warning, triangulated
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.tracking.features import Features

FRAMES = 6
ROOM = f"synthetic:frames={FRAMES},width=64,height=48"
WORLD = se3.exp(np.array([3.0, -2.0, 0.5, 0.4, -0.3, 0.9]))
"""The world of the file is not that of the run."""


def true_path(name: str = ROOM) -> Trajectory:
    found = open_source(name).truth()
    assert found is not None
    return Trajectory(found.timestamps_s, WORLD @ found.T_world_camera)


def plain_room(folder: Path) -> Path:
    """Write the room as a folder of images, without poses."""
    room = open_source(ROOM)
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True)
    for i in range(FRAMES):
        frame = room.frame(i)
        Image.fromarray(np.rint(frame.color * 255.0).astype(np.uint8)).save(folder / f"color/view{i}.png")
        Image.fromarray(np.rint(frame.depth_m * 1000.0).astype(np.uint16)).save(folder / f"depth/view{i}.png")
    c = room.camera
    fields = {"width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "depth_scale": 1000}
    (folder / "calibration.json").write_text(json.dumps(fields))
    return folder


def quaternion(T: np.ndarray) -> list[float]:
    return [float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat()]


def tum(path: Path, poses: Trajectory) -> Path:
    rows = zip(poses.timestamps_s, poses.T_world_camera, strict=True)
    lines = [" ".join(map(repr, (float(t), *map(float, T[:3, 3]), *quaternion(T)))) for t, T in rows]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines))
    return path


def kitti(path: Path, poses: Trajectory) -> Path:
    np.savetxt(path, poses.T_world_camera[:, :3].reshape(-1, 12))
    return path


def colmap(path: Path, poses: Trajectory) -> Path:
    """Write images.txt; points follow each image, on a line that may be empty."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for i, T in enumerate(poses.T_world_camera):
        inverse = se3.inverse(T)
        x, y, z, w = quaternion(inverse)
        lines.append(" ".join(map(repr, (i + 1, w, x, y, z, *map(float, inverse[:3, 3]), 1))) + f" color/view{i}.png")
        lines.append("1.5 2.5 -1 3.5 4.5 7 5.5 6.5 8 1 2 3" if i % 2 else "")
    path.write_text("\n".join(lines))
    return path


def transforms(path: Path, poses: Trajectory) -> Path:
    frames = [
        {"file_path": f"images/view{i}.png", "transform_matrix": (T @ FLIP_YZ).tolist()}
        for i, T in enumerate(poses.T_world_camera)
    ]
    path = path.with_suffix(".json")
    path.write_text(json.dumps({"frames": frames}))
    return path


def matrices(path: Path, poses: Trajectory) -> Path:
    path = path.with_suffix("")
    path.mkdir()
    for i, T in enumerate(poses.T_world_camera):
        np.savetxt(path / f"{i + 8}.txt", T)
    return path


WRITERS: list[Callable[[Path, Trajectory], Path]] = [tum, kitti, colmap, transforms, matrices]


def motions(poses: list[np.ndarray]) -> np.ndarray:
    return np.stack([se3.inverse(poses[0]) @ T for T in poses])


def given(source: Source) -> np.ndarray:
    found = [source.frame(i).T_given_camera for i in range(len(source))]
    assert all(T is not None for T in found)
    return motions(found)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_every_format_gives_each_frame_its_pose(tmp_path: Path, write: Callable[[Path, Trajectory], Path]) -> None:
    path = true_path()
    folder, file = plain_room(tmp_path / "room"), str(write(tmp_path / "poses.txt", path))
    source = open_source(folder, poses=file)
    assert len(source) == FRAMES
    np.testing.assert_allclose(given(source), motions(list(path.T_world_camera)), atol=1e-9)
    halved = open_source(folder, poses=file, poses_scale=0.5, stride=2)
    assert [halved.frame(i).timestamp_s for i in range(3)] == [source.timestamp_s(i) for i in (0, 2, 4)]
    np.testing.assert_allclose(given(halved)[:, :3, 3], 0.5 * given(source)[::2, :3, 3], atol=1e-9)


def test_frames_without_a_pose_are_left_out_and_named(tmp_path: Path) -> None:
    path = true_path()
    file = tum(tmp_path / "poses.txt", Trajectory(path.timestamps_s[[0, 2, 5]], path.T_world_camera[[0, 2, 5]]))
    source = open_source(ROOM, poses=str(file))
    assert [source.frame(i).timestamp_s for i in range(len(source))] == list(path.timestamps_s[[0, 2, 5]])
    assert [source.frame(i).index for i in range(3)] == [0, 1, 2]
    np.testing.assert_allclose(given(source), motions(list(path.T_world_camera[[0, 2, 5]])), atol=1e-9)
    assert [text.split(":")[0] for text in source.skipped] == [f"synthetic, frame {i}" for i in (1, 3, 4)]


def test_a_matrix_that_is_not_finite_is_a_frame_without_a_pose(tmp_path: Path) -> None:
    folder = matrices(tmp_path / "poses", true_path())
    (folder / "10.txt").write_text("inf " * 16)
    assert len(open_source(ROOM, poses=str(folder))) == FRAMES - 1


def test_the_poses_of_the_device_are_used_where_it_is_asked(tmp_path: Path) -> None:
    folder = recordings.write_stray(tmp_path / "walk", recordings.scene())
    source = open_source(folder, poses="recorded")
    path = source.truth()
    assert path is not None
    np.testing.assert_allclose(given(source), motions(list(path.T_world_camera[: len(source)])), atol=1e-9)
    with pytest.raises(SourceError, match="no poses that its device estimated; give a file of poses"):
        open_source(ROOM, poses="recorded")


def written(text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "poses.txt").write_text(text)
        return folder / "poses.txt"

    return write


ROW = "0 0 0 0 0 0 0 1\n"
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda folder: folder / "absent.txt", r"no such file or folder: .*absent.txt; give TUM or KITTI text"),
    "empty": (written("# nothing\n"), r"unknown format \(no poses\); give TUM or KITTI"),
    "other": (written("1 2 3\n"), r"unknown format \(a line of 3 values\); give TUM or KITTI"),
    "times": (written("900" + ROW[1:]), r"no pose is within 0.02 s of a frame \(poses 900.000 … 900.000 s, frames"),
    "quaternion": (written("0 0 0 0 0 0 0 2\n"), r"poses.txt:1: the pose is not rigid: its quaternion has length 2"),
    "words": (written("1 0 0 0 0 1 0 0 0 0 one 0\n"), r"poses.txt:1: expected numbers, found '1 0 0 0"),
    "mirror": (written("-1 0 0 0 0 1 0 0 0 0 1 0\n"), r"poses.txt:1: not a rigid camera-to-world pose"),
    "few": (written("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5), r"found 5 poses for 6 frames; give one for each frame, in order"),
    "infinite": (written("inf 0 0 0 0 1 0 0 0 0 1 0\n" * 6), "no pose is finite; give at least one finite pose"),
    "names": (written("1 1 0 0 0 0 0 0 1 photo.png\n"), r"named as photo, .*no names of images\); use the names of"),
    "folder": (lambda folder: folder, r"holds no .txt files with matrices; give TUM or KITTI"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_poses_that_do_not_fit_are_refused_in_one_line(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    make, message = BAD[name]
    path = make(tmp_path)
    with pytest.raises(SourceError, match=message):
        open_source(ROOM, poses=str(path))
    assert exit_code("run", ROOM, "--poses", str(path), "--out", str(tmp_path / "run")) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1 and not (tmp_path / "run").exists()


def test_poses_give_predicted_depth_its_scale_or_take_it_from_there(tmp_path: Path) -> None:
    room = "synthetic:frames=40,width=240,height=180,predicted=1"
    path, predicted = true_path(room), open_source(room).frame(3).depth_m
    half = path.T_world_camera.copy()
    half[:, :3, 3] *= 0.5
    file = str(tum(tmp_path / "half.txt", Trajectory(path.timestamps_s, half)))
    config = preset("sigma").changed(input={"poses": file})
    source, found = open_scene(room, config)
    assert found.input.predicted_scale == pytest.approx(0.5, rel=0.1) and found.input.poses_scale == 1.0
    for depth in (source.frame(3).depth_m, source.depth_of(3)):
        np.testing.assert_allclose(depth, predicted * found.input.predicted_scale, rtol=1e-6)
    np.testing.assert_allclose(given(source)[:, :3, 3], motions(list(half))[:, :3, 3], atol=1e-9)
    assert found.input.poses_scale_depth and found.tracking.fit_depth

    source, found = open_scene(room, config.changed(input={"poses_scale": 0.0}))
    assert found.input.poses_scale == pytest.approx(2.0, rel=0.1) and not found.input.poses_scale_depth
    np.testing.assert_array_equal(source.frame(3).depth_m, predicted)
    chosen = config.changed(input={"predicted_scale": 0.7})
    assert open_scene(room, chosen)[1].input == chosen.input

    still = tum(tmp_path / "still.txt", Trajectory(path.timestamps_s, np.tile(np.eye(4), (40, 1, 1))))
    with pytest.raises(SourceError, match=r"do not show the scale of predicted depth .*; give this factor"):
        open_scene(room, config.changed(input={"poses": str(still), "limit": 2}))


def test_given_motions_show_the_depth_of_features_and_which_matches_are_wrong() -> None:
    camera, rng = Camera(320, 240, 300.0, 300.0, 160.0, 120.0), np.random.default_rng(0)
    points = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (50, 3))
    T = se3.exp(np.array([0.3, 0.05, 0.1, 0.02, -0.04, 0.03]))

    def seen(x: np.ndarray) -> Features:
        pixels = x[:, :2] / x[:, 2:] * 300.0 + [160.0, 120.0]
        return Features(pixels, np.zeros((len(x), 1)), camera)

    first, second = seen(points), seen(points @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(triangulated(first, second, T), points[:, 2], rtol=1e-9)
    second.points[:5, 1] += 20.0
    assert (triangulated(first, second, T)[:5] == 0).all()
    assert (triangulated(first, first, np.eye(4)) == 0).all(), "no parallax"


@pytest.mark.slow
def test_a_run_with_poses_and_predicted_depth_has_the_scale_of_the_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = "synthetic:frames=40,width=240,height=180,predicted=1"
    file = str(tum(tmp_path / "poses.txt", true_path(room)))
    quick = ["input.width=80", "mapping.first_iterations=5", "mapping.iterations=2", "final.iterations=2"]
    settings = [word for setting in quick for word in ("--set", setting)]
    words = ["--poses", file, "--limit", "30", "--out", str(tmp_path / "run"), *settings]
    assert exit_code("run", room, *words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "predicted depth is multiplied by" in said and "scale is arbitrary" not in said
    run = RunFolder(tmp_path / "run")
    assert run.facts()["predicted_depth"] and run.config().input.predicted_scale == pytest.approx(1.0, rel=0.1)
    metrics = run.read_metrics()
    assert metrics["path_scale"] is None and metrics["ate"]["rmse_m"] < 1e-6


def test_nothing_moves_given_poses_unless_it_is_asked() -> None:
    config = preset("varsplat-fast").changed(input={"poses": "poses.txt"})
    found = for_scene(config, 1.0, None)
    assert not (found.mapping.lr_pose_translation or found.final.lr_pose_rotation or found.loops.close)
    assert preset("varsplat-fast").mapping.lr_pose_translation > 0
    asked = for_scene(config, 1.0, None, ["loops.close"])
    assert asked.loops.close and not asked.mapping.lr_pose_translation
    assert for_scene(Config(), 1.0, None) == Config()


def test_the_unit_of_poses_is_measured_and_a_wrong_one_is_reported(tmp_path: Path) -> None:
    room = "synthetic:frames=40,width=240,height=180"
    path = true_path(room)
    half = path.T_world_camera.copy()
    half[:, :3, 3] *= 0.5
    file = str(tum(tmp_path / "half.txt", Trajectory(path.timestamps_s, half)))
    config = preset("sigma").changed(input={"poses": file, "poses_scale": 0.0})
    source, found = open_scene(room, config)
    assert found.input.poses_scale == pytest.approx(2.0, rel=0.03)
    np.testing.assert_allclose(
        given(source)[:, :3, 3], 0.5 * found.input.poses_scale * motions(list(path.T_world_camera))[:, :3, 3], atol=1e-9
    )
    assert scale_warning(source, found) is None
    wrong = config.changed(input={"poses_scale": 1.0})
    assert "times as long as the given poses; are the poses in metres?" in (
        scale_warning(open_scene(room, wrong)[0], wrong) or ""
    )
    still = tum(tmp_path / "still.txt", Trajectory(path.timestamps_s, np.tile(np.eye(4), (40, 1, 1))))
    assert measured_scale(open_source(room, poses=str(still), limit=2), config) is None
    with pytest.raises(SourceError, match="the images do not show the unit of the poses; give the factor"):
        open_scene(room, config.changed(input={"poses": str(still), "limit": 2}))


def test_a_run_with_poses_ends_with_a_map_and_keeps_the_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tum(tmp_path / "poses.txt", true_path())
    quick = ["mapping.first_iterations=5", "mapping.iterations=2", "final.iterations=2"]
    words = ["--poses", "poses.txt", "--out", "run", "--no-eval", *(word for s in quick for word in ("--set", s))]
    assert exit_code("run", ROOM, *words) == 0
    run = RunFolder(tmp_path / "run")
    assert run.config().input.poses == str(tmp_path / "poses.txt") and not run.config().loops.close
    found, expected = run.read_trajectory().T_world_camera, motions(list(true_path().T_world_camera))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert len(run.read_map())
    monkeypatch.chdir("/")
    assert exit_code("eval", str(run.path)) == 0


def test_poses_of_another_convention_are_reported_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """World to camera, as COLMAP writes it, in the place of camera to world."""
    room = "synthetic:frames=12,width=160,height=120"
    path = true_path(room)
    file = tum(
        tmp_path / "poses.txt", Trajectory(path.timestamps_s, np.stack([se3.inverse(T) for T in path.T_world_camera]))
    )
    quick = ["mapping.first_iterations=5", "mapping.iterations=2", "final.iterations=0", "uncertainty.probes=0"]
    words = [
        "--poses",
        str(file),
        "--out",
        str(tmp_path / "run"),
        "--no-eval",
        *(w for s in quick for w in ("--set", s)),
    ]
    assert exit_code("run", room, *words) == 0
    assert "the images contradict the given pose in" in " ".join(capsys.readouterr().err.split())
