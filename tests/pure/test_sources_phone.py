"""Recordings of phones: Stray Scanner's folders, Record3D's files and exports."""

from pathlib import Path

import numpy as np
import pytest

from recordings import FRAMES, r3d_members, scene, write_exr_export, write_stray, write_zip
from sigmasplat.data.camera import Camera
from sigmasplat.input.images import Video
from sigmasplat.plugins.sources import open_source

pytest.importorskip("lzfse", reason="Record3D needs the extra iphone")

LARGE, SMALL = (64, 48), (32, 24)


def nearest_halved(color: np.ndarray) -> np.ndarray:
    """Average squares of 2×2 pixels."""
    return color.reshape(24, 2, 32, 2, 3).mean((1, 3)) / 255.0


def test_stray_scanner(tmp_path: Path) -> None:
    seen = scene(LARGE, SMALL)
    source = open_source(write_stray(tmp_path / "71de12f9", seen))
    assert (source.name, len(source), source.skipped) == ("71de12f9", FRAMES, [])
    assert source.camera == Camera(64, 48, 40.0, 40.0, 32.0, 24.0).resized(32, 24)
    assert source.depth_registered and source.depth_units_per_metre == 1000.0
    for frame, color, depth, t in zip(source, seen.colors, seen.depths_mm, seen.times_s, strict=True):
        assert frame.timestamp_s == pytest.approx(t, abs=1e-6)
        expected = (depth / 1000.0).astype(np.float32)
        expected[-1, -1] = 0  # confidence 0; readings with 1 are kept
        assert np.array_equal(frame.depth_m, expected)
        assert np.abs(frame.color - nearest_halved(color)).mean() < 0.03  # MPEG-4
        assert np.abs(source.depth_of(frame.index) - expected).max() == 0


def test_stray_scanner_poses_use_our_axes(tmp_path: Path) -> None:
    seen = scene(LARGE, SMALL)
    truth = open_source(write_stray(tmp_path / "scan", seen)).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, seen.poses, atol=1e-6)
    np.testing.assert_allclose(truth.timestamps_s, seen.times_s, atol=1e-6)


def test_stray_scanner_prefers_intrinsics_per_frame(tmp_path: Path) -> None:
    seen = scene(SMALL)
    source = open_source(write_stray(tmp_path / "scan", seen, per_frame=True))
    assert source.camera.fx == pytest.approx(41.5)  # the median of 40, 41, 42, 43
    assert not source.depth_registered  # equal sizes: no registration needed


def test_a_truncated_video_loses_its_last_frames(tmp_path: Path) -> None:
    folder = write_stray(tmp_path / "scan", scene(SMALL))
    for part in ("depth", "confidence"):
        last = folder / part / f"{FRAMES - 1:06d}.png"
        last.with_name(f"{FRAMES:06d}.png").write_bytes(last.read_bytes())
    source = open_source(folder)
    assert len(source) == FRAMES
    assert source.skipped == [f"{folder}/depth/{FRAMES:06d}.png: no frame {FRAMES} in rgb.mp4 or odometry.csv"]


def test_video_frames_can_be_read_in_any_order(tmp_path: Path) -> None:
    video = Video(write_stray(tmp_path / "scan", scene(SMALL)) / "rgb.mp4")
    assert (video.size, video.count) == (SMALL, FRAMES)
    in_order = [video.frame(i) for i in range(FRAMES)]
    assert len({frame.tobytes() for frame in in_order}) == FRAMES
    for i in (2, 0, 3, 3, 1):
        assert np.array_equal(video.frame(i), in_order[i])


@pytest.mark.parametrize("packed", [True, False])
def test_record3d(tmp_path: Path, packed: bool) -> None:
    seen = scene(LARGE, SMALL)
    members, path = r3d_members(seen), tmp_path / "desk.r3d"
    if packed:
        write_zip(path, members)
    else:
        for name, data in members.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(data)
    source = open_source(path)
    assert (source.name, len(source), source.skipped) == ("desk", FRAMES, [])
    assert source.camera == Camera(64, 48, 40.0, 41.0, 31.0, 24.0).resized(32, 24)
    for frame, color, depth, t in zip(source, seen.colors, seen.depths_mm, seen.times_s, strict=True):
        assert frame.timestamp_s == t
        expected = (depth / 1000.0).astype(np.float32)
        expected[-1, -1] = 0
        assert np.array_equal(frame.depth_m, expected)  # NaN became 0
        assert np.abs(frame.color - nearest_halved(color)).max() < 0.03


def test_record3d_poses_are_converted_from_opengl_axes(tmp_path: Path) -> None:
    seen = scene(SMALL)
    truth = open_source(write_zip(tmp_path / "a.r3d", r3d_members(seen))).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, seen.poses, atol=1e-9)
    assert truth.timestamps_s.tolist() == seen.times_s.tolist()


def test_record3d_front_camera_has_no_path(tmp_path: Path) -> None:
    still = [[0, 0, 0, 1, 0, 0, 0]] * FRAMES
    assert open_source(write_zip(tmp_path / "a.r3d", r3d_members(scene(SMALL), poses=still))).truth() is None


def test_record3d_without_times_uses_its_frame_rate(tmp_path: Path) -> None:
    source = open_source(write_zip(tmp_path / "a.r3d", r3d_members(scene(SMALL), frameTimestamps=None, fps=60)))
    assert [frame.timestamp_s for frame in source] == [i / 60 for i in range(FRAMES)]


def test_record3d_intrinsics_are_scaled_to_the_image_size(tmp_path: Path) -> None:
    """High-resolution exports keep w, h and K of the preview."""
    members = r3d_members(scene(LARGE, SMALL), w=32, h=24, perFrameIntrinsicCoeffs=[[20.0, 21.0, 16.0, 12.0]] * FRAMES)
    camera = open_source(write_zip(tmp_path / "a.r3d", members), register_depth="auto").camera
    assert camera == Camera(32, 24, 20.0, 21.0, 16.0, 12.0)


def test_record3d_export(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR", reason="EXR needs the extra iphone")
    seen = scene(LARGE, SMALL)
    source = open_source(write_exr_export(tmp_path / "EXR_RGBD", seen))
    assert len(source) == FRAMES and source.truth() is not None
    for frame, depth in zip(source, seen.depths_mm, strict=True):
        assert np.array_equal(frame.depth_m, (depth / 1000.0).astype(np.float32))
