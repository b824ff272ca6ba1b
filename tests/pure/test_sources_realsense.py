"""The live camera with a fake SDK: frames, recording, dropped frames, and how a sequence ends."""

import sys
from pathlib import Path

import numpy as np
import pytest

from fake_realsense import Device, distortion
from paper_settings import InputConfig
from sigmasplat.errors import RunError, SourceError
from sigmasplat.input.recorded import depth_warning
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.live import LiveSource, recording_settings
from sigmasplat.plugins.sources.realsense import WARM_UP_FRAMES


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device()
    monkeypatch.setitem(sys.modules, "pyrealsense2", made.module())
    return made


def opened(**settings: object) -> LiveSource:
    source = open_source("realsense", **settings)
    assert isinstance(source, LiveSource)
    return source


def test_frames_equal_those_of_the_camera(device: Device) -> None:
    source = opened(limit=3)
    frames = list(source)
    assert source.camera == device.room.camera and source.depth_units_per_metre == 2000.0
    assert device.asked == [("depth", 640, 480, "z16", 30), ("color", 640, 480, "rgb8", 30)]
    for i, frame in enumerate(frames):
        seen = device.room.frame(WARM_UP_FRAMES + 1 + i)
        assert (frame.index, frame.timestamp_s) == (i, pytest.approx((WARM_UP_FRAMES + 1 + i) / 30))
        assert np.array_equal(frame.color, seen.color)
        assert np.abs(frame.depth_m - seen.depth_m).max() <= 0.5 * 0.0005 + 1e-6
    assert (device.started, device.stopped) == (1, 1) and source.dropped == 0


def test_options_reach_the_camera(device: Device) -> None:
    open_source("realsense:width=848,height=480,fps=60,serial=0123")
    assert device.asked[0] == ("depth", 848, 480, "z16", 60) and device.serial == "0123"


def test_an_unused_camera_is_stopped(device: Device) -> None:
    source = opened()
    del source
    assert (device.started, device.stopped) == (1, 1)


def test_every_frame_is_recorded_immediately(device: Device, tmp_path: Path) -> None:
    source = opened(limit=5)
    source.record_to(tmp_path / "recording")
    live = []
    for frame in source:
        live.append(frame)
        assert len(open_source(tmp_path / "recording")) >= len(live)  # readable at any moment
    again = open_source(tmp_path / "recording")
    assert len(again) == 5 and again.camera == source.camera and again.truth() is None
    for one, other in zip(live, again, strict=True):
        assert one.timestamp_s == pytest.approx(other.timestamp_s, abs=1e-6)
        assert np.array_equal(one.color, other.color)
        assert np.abs(one.depth_m - other.depth_m).max() <= 0.5 / 5000 + 1e-6  # TUM's unit


def test_a_recording_is_not_overwritten(device: Device, tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("")
    with pytest.raises(RunError, match="already holds a sequence"):
        opened(limit=1).record_to(tmp_path)


def test_dropped_frames_are_counted_and_the_newest_is_used(device: Device) -> None:
    device.missed_between = 2
    source = opened(limit=4)
    times = [frame.timestamp_s for frame in source]
    assert np.diff(times) == pytest.approx([3 / 30] * 3)
    assert source.dropped >= 2 * 3  # one more set may be read ahead


def test_a_repeated_colour_image_is_used_once(device: Device) -> None:
    device.repeats = 2
    assert np.diff([frame.timestamp_s for frame in opened(limit=4)]) == pytest.approx([1 / 30] * 3)


def test_stride_and_time_count_from_the_first_frame(device: Device) -> None:
    times = [frame.timestamp_s for frame in opened(stride=2, start_s=0.12, end_s=0.3)]
    begin_s = (WARM_UP_FRAMES + 1) / 30
    assert times == pytest.approx([begin_s + i / 30 for i in (4, 6, 8)])


def test_unplugging_ends_the_sequence_with_a_reason(device: Device, tmp_path: Path) -> None:
    device.frames_until_unplugged = WARM_UP_FRAMES + 4
    source = opened()
    source.record_to(tmp_path / "recording")
    assert len(list(source)) == 4
    assert "no frame for 5 s (Frame didn't arrive within 5000)" in source.ending and "\n" not in source.ending
    assert len(open_source(tmp_path / "recording")) == 4 and device.stopped == 1


def test_a_camera_that_delivers_nothing_is_an_error(device: Device) -> None:
    device.frames_until_unplugged = 0
    with pytest.raises(SourceError, match="is the camera plugged in"):
        list(opened())


def test_lens_distortion_is_removed(device: Device) -> None:
    device.coefficients = [0.1, -0.05, 0.001, -0.002, 0.01]
    with_lens = next(iter(opened(limit=1)))
    plain = next(iter(opened(limit=1, undistort=False)))
    assert not np.array_equal(with_lens.color, plain.color)
    device.model = distortion.kannala_brandt4
    with pytest.raises(SourceError, match="lens model"):
        opened()
    assert device.started == device.stopped


@pytest.mark.parametrize("ask", [len, lambda s: s.frame(0), lambda s: s.timestamp_s(0), depth_warning])
def test_operations_that_need_a_recording_raise(device: Device, ask: object) -> None:
    with pytest.raises(SourceError, match="run it, then read the folder"):
        ask(opened())  # type: ignore[operator]


def test_a_recording_is_not_subsampled_or_rectified_again() -> None:
    given = InputConfig(stride=3, limit=9, start_s=1.0, fx=5.0, depth_scale=9.0, crop_px=4, width=320, strict=True)
    assert recording_settings(given) == InputConfig(crop_px=4, width=320, strict=True)
