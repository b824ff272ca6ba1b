"""The motion module of a live camera with a fake SDK: its axes, its clock, and what goes wrong."""

import itertools
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fake_realsense import Device, MotionSensor, clock, format_, stream
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.sources.live import LiveSource
from sigmasplat.plugins.sources.realsense import PATIENCE_S, WAITING_MOST, WARM_UP_FRAMES, MotionModule

R_COLOR_IMU = Rotation.from_rotvec([1.2, -0.7, 2.0]).as_matrix()
VELOCITY = np.array([0.2, 1.5, -0.4])
PATIENT_FRAMES = WARM_UP_FRAMES + int(PATIENCE_S * 30)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device()
    made.room = SyntheticRoom(frames=8, width=80, height=60, noise=False)
    monkeypatch.setitem(sys.modules, "pyrealsense2", made.module())
    return made


def equipped(device: Device) -> MotionSensor:
    """Add a motion module that turns with the camera."""
    device.motion = MotionSensor(R_COLOR_IMU)
    device.motion.angular_velocity = lambda time_s: VELOCITY
    return device.motion


def opened(path: str = "realsense", **settings: object) -> LiveSource:
    source = open_source(path, **settings)
    assert isinstance(source, LiveSource)
    return source


def check_turns(frames: list[Frame], velocity: np.ndarray, atol: float = 1e-7) -> None:
    """Check the rotation between each two frames."""
    for before, now in itertools.pairwise(frames):
        assert before.R_inertial_camera is not None and now.R_inertial_camera is not None
        expected = Rotation.from_rotvec(velocity * (now.timestamp_s - before.timestamp_s)).as_matrix()
        np.testing.assert_allclose(before.R_inertial_camera.T @ now.R_inertial_camera, expected, atol=atol)


@pytest.mark.parametrize("axis", range(3))
def test_a_turn_about_an_axis_of_the_colour_camera(device: Device, axis: int) -> None:
    velocity = 1.3 * np.eye(3)[axis]
    equipped(device).angular_velocity = lambda time_s: velocity
    source = opened(limit=5)
    frames = list(source)
    check_turns(frames, velocity)
    for frame in frames:
        np.testing.assert_allclose(frame.specific_force_m_s2, (0.0, -9.81, 0.0), atol=1e-9)
    assert source.notes == [] and source.ending == ""


def test_a_changing_velocity_is_integrated_from_image_to_image(device: Device) -> None:
    equipped(device).angular_velocity = lambda time_s: VELOCITY * time_s
    frames = list(opened(limit=9, stride=2))
    assert frames[1].timestamp_s - frames[0].timestamp_s == pytest.approx(2 / 30)
    for before, now in itertools.pairwise(frames):
        middle_s = (before.timestamp_s + now.timestamp_s) / 2
        check_turns([before, now], VELOCITY * middle_s, atol=5e-4)


def test_one_rate_of_each_stream_is_opened(device: Device) -> None:
    motion = equipped(device)
    source = opened()
    chosen = [(profile.kind.name, profile.hz, profile.format()) for profile in motion.opened]
    assert chosen == [("gyro", 200, format_.motion_xyz32f), ("accel", 250, format_.motion_xyz32f)]
    del source


def test_a_gyroscope_alone_is_used(device: Device) -> None:
    equipped(device).rates_hz = {stream.gyro: (400,)}
    frames = list(opened(limit=3))
    check_turns(frames, VELOCITY)
    assert [frame.specific_force_m_s2 for frame in frames] == [None] * 3


def test_frames_are_the_same_with_and_without_a_motion_module(device: Device) -> None:
    plain = list(opened(limit=3))
    assert [frame.R_inertial_camera for frame in plain] == [frame.specific_force_m_s2 for frame in plain] == [None] * 3
    device.number, motion = 0, equipped(device)
    switched_off = list(opened("realsense:imu=0", limit=3))
    assert motion.calls == []
    device.number = 0
    for first, *others in zip(plain, switched_off, opened(limit=3), strict=True):
        for other in others:
            assert (first.index, first.timestamp_s, first.camera) == (other.index, other.timestamp_s, other.camera)
            assert np.array_equal(first.color, other.color) and np.array_equal(first.depth_m, other.depth_m)
    assert [frame.R_inertial_camera for frame in switched_off] == [None] * 3


def test_a_device_without_motion_module_is_not_reported(device: Device) -> None:
    source = opened(limit=2)
    assert len(list(source)) == 2 and source.notes == []


# ---- what goes wrong ----


@pytest.mark.parametrize("step", ["get_stream_profiles", "get_extrinsics_to", "open", "start"])
@pytest.mark.parametrize("error", [RuntimeError("Device or resource\n busy"), AttributeError("gyro")])
def test_a_motion_module_that_cannot_be_opened_is_left_out(device: Device, step: str, error: Exception) -> None:
    motion = equipped(device)
    motion.failing[step] = error
    source = opened(limit=3)
    frames = list(source)
    assert [frame.R_inertial_camera for frame in frames] == [None] * 3
    assert len(source.notes) == 1 and "cannot be opened" in source.notes[0] and "imu=0" in source.notes[0]
    assert " ".join(str(error).split()) in source.notes[0] and "\n" not in source.notes[0]
    assert motion.opened == [] and (device.started, device.stopped) == (1, 1)


def test_axes_that_are_no_rotation_are_refused(device: Device) -> None:
    device.motion = MotionSensor(np.zeros((3, 3)))
    source = opened(limit=2)
    assert len(list(source)) == 2 and "its axes relative to the camera are not known" in source.notes[0]
    assert "open" not in device.motion.calls


def test_samples_of_another_clock_are_not_used(device: Device) -> None:
    equipped(device).clock = lambda time_s: clock.hardware_clock
    device.clock = lambda number: clock.system_time
    source = opened(limit=PATIENT_FRAMES + 40)
    assert {frame.R_inertial_camera is None for frame in source} == {True}
    assert len(source.notes) == 1
    assert "no sample had the clock of the images" in source.notes[0]


@pytest.mark.parametrize("later_s", [-0.01, 0.15])
def test_the_clock_may_change_in_the_first_frames(device: Device, later_s: float) -> None:
    """The SDK converts times only when it knows how; the first ones are those of the device. Images and samples do not
    change together."""
    after_s = (WARM_UP_FRAMES + 4.5) / 30
    sampled_s = after_s + later_s
    equipped(device).clock = lambda time_s: clock.hardware_clock if time_s < sampled_s else clock.global_time
    device.clock = lambda number: clock.hardware_clock if number / 30 < after_s else clock.global_time
    source = opened(limit=PATIENT_FRAMES + 20)
    frames = list(source)
    check_turns(frames[:3], VELOCITY)
    check_turns(frames[12:], VELOCITY)
    unknown = [frame.R_inertial_camera is None for frame in frames]
    assert any(unknown[4:6]) and sum(unknown) == sum(unknown[4:12])
    assert source.notes == []


def test_times_that_differ_much_are_not_used(device: Device) -> None:
    equipped(device).ahead_s = 500.0
    source = opened(limit=PATIENT_FRAMES + 20)
    assert {frame.R_inertial_camera is None for frame in source} == {True}
    assert len(source.notes) == 1 and "no sample had the clock" in source.notes[0]


def test_a_silent_motion_module_is_reported_once(device: Device) -> None:
    equipped(device).late_s = 1e6
    source = opened(limit=PATIENT_FRAMES + 40)
    assert {frame.R_inertial_camera is None for frame in source} == {True}
    assert len(source.notes) == 1 and "for 3 s no sample" in source.notes[0]


def test_a_motion_module_that_falls_silent_is_reported(device: Device) -> None:
    motion = equipped(device)
    motion.before_delivery = lambda time_s: setattr(motion, "late_s", 1e6 if time_s > 2.0 else 0.0)
    source = opened(limit=60 + PATIENT_FRAMES)
    frames = list(source)
    check_turns([frame for frame in frames if frame.timestamp_s < 2.0], VELOCITY)
    assert frames[-1].R_inertial_camera is frames[-1].specific_force_m_s2 is None
    assert len(source.notes) == 1 and "no sample had the clock" in source.notes[0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_dropped(device: Device, value: float) -> None:
    motion = equipped(device)

    def broken(measured: Callable[[float], np.ndarray]) -> Callable[[float], np.ndarray]:
        return lambda time_s: np.full(3, value) if round(time_s * 1000) % 3 == 0 else measured(time_s)

    motion.angular_velocity = broken(lambda time_s: VELOCITY)
    motion.specific_force = broken(lambda time_s: np.array([0.0, -9.81, 0.0]))
    source = opened(limit=5)
    frames = list(source)
    check_turns(frames, VELOCITY)
    np.testing.assert_allclose([frame.specific_force_m_s2 for frame in frames], [(0.0, -9.81, 0.0)] * 5, atol=1e-9)
    assert source.notes == []


def test_late_samples_do_not_delay_an_image(device: Device) -> None:
    """The newest velocity is taken to continue."""
    equipped(device).late_s = 0.02
    check_turns(list(opened(limit=5)), VELOCITY)


def test_samples_that_are_very_late_are_not_used(device: Device) -> None:
    equipped(device).late_s = 0.15
    assert [frame.R_inertial_camera for frame in opened(limit=3)] == [None] * 3


# ---- stopping ----


def test_the_end_stops_and_closes_the_motion_module(device: Device) -> None:
    motion = equipped(device)
    list(opened(limit=2))
    assert motion.calls[-2:] == ["stop", "close"] and motion.opened == [] and device.stopped == 1


def test_an_unused_camera_releases_the_motion_module(device: Device) -> None:
    motion, source = equipped(device), opened()
    assert motion.opened
    del source
    assert motion.calls[-2:] == ["stop", "close"] and device.stopped == 1


def test_a_motion_module_that_cannot_be_stopped_does_not_keep_the_camera(device: Device) -> None:
    motion = equipped(device)
    motion.failing["stop"] = RuntimeError("No such device")
    list(opened(limit=2))
    assert motion.calls[-2:] == ["stop", "close"] and (device.started, device.stopped) == (1, 1)


def test_no_images_may_be_due_to_the_motion_module(device: Device) -> None:
    motion = equipped(device)
    device.frames_until_unplugged = WARM_UP_FRAMES + 2
    source = opened()
    assert len(list(source)) == 2 and source.ending.endswith("is the camera plugged in? If so, try realsense:imu=0")
    assert motion.opened == []


# ---- the samples that wait ----


def motion_frame(time_s: float) -> SimpleNamespace:
    sample = SimpleNamespace(
        get_motion_data=lambda: SimpleNamespace(x=1.0, y=2.0, z=3.0), get_timestamp=lambda: 1000.0 * time_s,
        get_profile=lambda: SimpleNamespace(stream_type=lambda: stream.gyro),
        get_frame_timestamp_domain=lambda: clock.global_time,
    )  # fmt: skip
    return SimpleNamespace(as_motion_frame=lambda: sample)


def test_only_the_newest_samples_wait() -> None:
    waiting = MotionModule(None, {}, (stream.gyro, stream.accel), [])
    for k in range(WAITING_MOST + 500):
        waiting.receive(motion_frame(float(k)))
    taken = waiting.taken()
    assert len(taken) == WAITING_MOST and taken[-1].time_s == WAITING_MOST + 499 and waiting.taken() == []


def test_frames_that_are_no_samples_are_left_out() -> None:
    waiting = MotionModule(None, {}, (stream.gyro, stream.accel), [])
    waiting.receive(SimpleNamespace(as_motion_frame=lambda: None))
    waiting.receive(motion_frame(np.nan))
    assert waiting.taken() == []


def test_samples_are_taken_while_another_thread_adds_them() -> None:
    waiting, count, taken = MotionModule(None, {}, (stream.gyro, stream.accel), []), 3000, []
    adding = threading.Thread(target=lambda: [waiting.receive(motion_frame(float(k))) for k in range(count)])
    adding.start()
    while adding.is_alive():
        taken += waiting.taken()
    adding.join()
    taken += waiting.taken()
    assert [sample.time_s for sample in taken] == list(range(count))


def test_a_recording_has_the_images_of_the_run(device: Device, tmp_path: Path) -> None:
    equipped(device)
    source = opened(limit=3)
    source.record_to(tmp_path / "recording")
    live = list(source)
    assert live[0].R_inertial_camera is not None
    assert len(open_source(tmp_path / "recording")) == 3
