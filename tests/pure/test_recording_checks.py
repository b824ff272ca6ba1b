"""What `inspect` and `run` report about times, calibration and consecutive frames of a recording."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import bag_recordings
import layouts
from command_line import exit_code
from paper_settings import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import refuse_impossible_camera, unlikely_camera
from sigmasplat.plugins.checks.motion import Motion, MotionWatch, motion_warnings, rate, time_warnings
from sigmasplat.plugins.checks.recording import inspect_source
from sigmasplat.plugins.sources import open_source

TIMES = np.arange(30) / 30.0
FRAMES = 90


@pytest.fixture(scope="module")
def shaken() -> Motion:
    """Return a textured wall seen by a camera with uneven motion: its distance and position change together."""
    rng = np.random.default_rng(0)
    texture = 20 * gaussian_filter(rng.uniform(-0.5, 0.5, size=(60, 400)), 6.0) + 0.5
    x = 30 + np.cumsum(rng.uniform(1.0, 3.0, FRAMES))
    column, row = np.arange(80), np.arange(60)[:, None]
    gray = np.stack([np.stack([np.interp(column + at, np.arange(400), line) for line in texture]) for at in x])
    depth = np.stack([2 + 0.5 * np.sin((column + at) / 9.0) + 0 * row for at in x])
    return Motion(np.arange(FRAMES) / 30.0, gray.astype(np.float32), depth.astype(np.float32))


def test_no_warning_of_a_recording_without_faults(shaken: Motion) -> None:
    assert motion_warnings(shaken) == []


@pytest.mark.parametrize("delay", [-5, -2, 1, 3, 6])
def test_delay_of_depth_is_estimated(shaken: Motion, delay: int) -> None:
    n = FRAMES - abs(delay)
    gray, depth = shaken.gray[max(delay, 0) :][:n], shaken.depth_m[max(-delay, 0) :][:n]
    late = Motion(shaken.times_s[:n], gray, depth)
    assert late.delay_frames() == pytest.approx(delay, abs=0.3)
    (warning,) = motion_warnings(late)
    assert warning.startswith("depth is" if delay > 0 else "colour is") and "`sigmasplat calibrate PATH`" in warning


def test_a_still_camera_has_no_delay(shaken: Motion) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, shaken.gray.shape).astype(np.float32)
    still = Motion(shaken.times_s, shaken.gray[:1] + noise, shaken.depth_m[:1] + noise[::-1])
    assert still.delay_frames() is None and motion_warnings(still) == []


def test_forty_frames_of_a_smooth_motion_show_no_delay() -> None:
    """So few independent frames correlate by chance: 6 frames of delay were found here."""
    room = open_source("synthetic:frames=120,width=80,height=60", limit=40)
    assert motion_warnings(Motion.of(room)) == []


def test_black_frames_and_jumps_are_found() -> None:
    x = np.arange(60) * 1.5
    texture = np.sin(np.arange(400) / 3.0) * np.sin(np.arange(400) / 11.0) / 2 + 0.5
    gray = np.stack([np.tile(np.interp(np.arange(80) + at, np.arange(400), texture), (8, 1)) for at in x])
    steady = Motion(np.arange(60) / 30.0, gray.astype(np.float32), np.full((60, 8, 80), 2.0, np.float32))
    assert motion_warnings(steady, 7) == []
    dark = steady.gray.copy()
    dark[30:40] = 0.0
    assert motion_warnings(replace(steady, gray=dark), 7)[0].startswith("10 frames are black (first: frame 37)")
    far = np.concatenate([steady.gray[:25], 1.0 - steady.gray[25:, :, ::-1]])
    for images in (steady.gray, dark, far):  # a run finds the same while it takes the frames
        watch, whole = MotionWatch(), replace(steady, gray=images)
        for i, image in enumerate(images):
            color = np.repeat(image[..., None], 3, axis=2)
            watch(Frame(i + 7, i / 30.0, color, steady.depth_m[0], Camera(80, 8, 60.0, 60.0, 39.5, 3.5)))
        assert watch.warnings() == motion_warnings(whole, 7)
    assert "jumps 1 times (first: before frame 32)" in watch.warnings()[0]


@pytest.mark.parametrize("what", ["depth late", "no depth", "nothing"])
def test_what_drifts_during_a_run_is_said_once_and_at_once(shaken: Motion, what: str) -> None:
    """Depth falls behind colour, or is lost, after a third of a recording; a steady one is quiet."""
    depth_m, gray = np.concatenate([shaken.depth_m] * 3), np.concatenate([shaken.gray] * 3)
    if what == "depth late":
        depth_m[FRAMES:] = np.roll(depth_m[FRAMES:], 4, axis=0)
    if what == "no depth":
        depth_m[FRAMES:, :, 20:] = 0.0
    said = list[tuple[int, str]]()
    watch = MotionWatch(lambda line: said.append((i, line)))
    for i, (image, depth) in enumerate(zip(gray, depth_m, strict=True)):
        color = np.repeat(image[..., None], 3, axis=2)
        watch(Frame(i, i / 30.0, color, depth, Camera(80, 60, 60.0, 60.0, 39.5, 29.5)))
    assert not [line for line in watch.warnings() if "depth" in line]
    assert all(small.base is None for _, *images in watch.recent for small in images), "whole images stay in memory"
    if what == "nothing":
        assert not said
        return
    ((frame, line),) = said
    assert FRAMES <= frame < 3 * FRAMES - 1 and line.startswith(f"about frame {frame}: ")
    assert ("depth is 0.1" in line and "behind colour" in line) if what == "depth late" else "0% at first" in line


def test_times_are_checked_for_unit_order_and_gaps() -> None:
    assert time_warnings(TIMES) == [] and time_warnings(TIMES[:1]) == []
    assert f"{rate(TIMES * 1e3)} frames per second" in time_warnings(TIMES * 1e3)[0]
    assert [rate(np.arange(5) * step_s) for step_s in (1 / 30, 2.6e-5, 1e3, 0.0)] == ["30.0", "38461.5", "0.001", "–"]
    assert "frames per second" in time_warnings(TIMES * 1e-6)[0]
    same = TIMES.copy()
    same[[5, 9]] = same[[4, 8]]
    assert time_warnings(same)[0].startswith("2 frames have the same time")
    assert time_warnings(TIMES + np.where(np.arange(30) > 10, 4.0, 0.0))[0].startswith("1 gaps in time (longest: 4.0 s")


@pytest.mark.parametrize("wrong", [{"fx": 0.5}, {"fy": 0.5}, {"fx": 1e5}, {"cx": -1000.0}, {"cy": 120.0}])
def test_intrinsics_of_no_camera_are_refused(wrong: dict[str, float]) -> None:
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    refuse_impossible_camera("room", camera)
    assert unlikely_camera(camera) is None
    with pytest.raises(SourceError, match=r"^room: .*(field of view|principal point)"):
        refuse_impossible_camera("room", replace(camera, **wrong))


@pytest.mark.parametrize("odd", [{"fx": 40.0, "fy": 40.0}, {"fy": 90.0}, {"cx": 20.0}])
def test_unusual_intrinsics_are_reported(odd: dict[str, float]) -> None:
    assert unlikely_camera(replace(Camera(160, 120, 140.0, 140.0, 79.5, 59.5), **odd)) is not None


def test_a_damaged_calibration_is_one_line(tiny_tum: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tiny_tum / "calibration.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"cx": -1000.0}))
    assert exit_code("inspect", str(tiny_tum)) == 2
    assert "principal point" in capsys.readouterr().err


def test_lists_in_different_units_are_refused(tiny_tum: Path) -> None:
    lines = [line.split() for line in (tiny_tum / "depth.txt").read_text().splitlines() if line[0] != "#"]
    (tiny_tum / "depth.txt").write_text("".join(f"{float(t) * 1e6} {path}\n" for t, path in lines))
    with pytest.raises(SourceError, match=r"different units \(median steps: rgb\.txt 0\.1, depth\.txt 100000\)"):
        open_source(tiny_tum)


def test_images_without_depth_are_counted_with_the_reason(tiny_tum: Path) -> None:
    file = tiny_tum / "depth.txt"
    file.write_text("\n".join(file.read_text().splitlines()[:-2]) + "\n")
    warnings = inspect_source(tiny_tum, InputConfig()).warnings
    assert any("2 of 4 images are not used" in warning and "no depth within" in warning for warning in warnings)


def test_times_of_a_bag_and_of_redwood_in_different_units_are_refused(tmp_path: Path) -> None:
    sample = layouts.sample()
    folder = layouts.redwood(tmp_path, sample)
    for i, file in enumerate(sorted((folder / "depth").iterdir())):  # milliseconds instead of microseconds
        file.rename(file.with_name(f"{i + 1:07d}-{33 * (i + 1):012d}.png"))
    with pytest.raises(SourceError, match="times are in different units"):
        open_source(folder)
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    recorder = bag_recordings.Recorder()
    for i in range(4):
        for topic, unit, image, kind in (
            (bag_recordings.CAMERA_TOPICS[0], 1.0, sample.color[0], "rgb8"),
            (bag_recordings.CAMERA_TOPICS[1], 1000.0, sample.depth_mm[0], "16UC1"),
        ):
            recorder.image(topic, unit * (1 + i / 30), image, kind, "camera")
    recorder.info("/camera/color/camera_info", 1.0, (32, 24), bag_recordings.FOCAL, "camera")
    with pytest.raises(SourceError, match="times are in different units"):
        open_source(recorder.write(tmp_path / "bag"))
