"""A fake pyrealsense2: the part of its interface that is used, filming the synthetic room.

Names, arguments and units as in pyrealsense2 2.59: depth as whole numbers of `get_depth_scale()` metres, times in
milliseconds, frame numbers that increase while no frame is read, RuntimeError if no frame arrives. A motion module is
added with `Device.motion`; its samples come before the image that is requested, those that are late after it.
"""

from collections.abc import Callable
from enum import Enum
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from sigmasplat.plugins.sources import SyntheticRoom

stream = Enum("stream", "depth color gyro accel")
format_ = Enum("format", "z16 rgb8 motion_xyz32f combined_motion")
clock = Enum("timestamp_domain", "hardware_clock system_time global_time")
EARLIER_S = {clock.hardware_clock: 5000.0, clock.system_time: 0.0, clock.global_time: 0.0}
"""By how much the times of each clock are smaller."""
distortion = Enum(
    "distortion", "none brown_conrady inverse_brown_conrady modified_brown_conrady kannala_brandt4 ftheta"
)


class Device:
    """The simulated camera: its images, when it is unplugged, and other events when a frame is requested."""

    def __init__(self, width: int = 80, height: int = 60, scale_m: float = 0.0005) -> None:
        self.room = SyntheticRoom(frames=60, width=width, height=height, noise=False)
        self.scale_m = scale_m
        self.coefficients, self.model = [0.0] * 5, distortion.inverse_brown_conrady
        self.plugged_in = True
        self.frames_until_unplugged = 10**9
        self.missed_between = self.repeats = 0
        self.must_align = True
        self.asked: list[tuple[Any, ...]] = []
        self.serial = ""
        self.started = self.stopped = 0
        self.number = 0
        self.on_frame: Callable[[int], None] = lambda number: None
        self.clock: Callable[[int], Any] = lambda number: clock.global_time
        self.motion: MotionSensor | None = None
        self.seen = cache(lambda number: self.room.frame(number % len(self.room)))

    def module(self) -> ModuleType:
        """Return the module for `import pyrealsense2`."""
        made = ModuleType("pyrealsense2")
        names = {"stream": stream, "format": format_, "distortion": distortion}
        for name, value in names.items():
            setattr(made, name, value)
        made.pipeline = lambda: _Pipeline(self)  # type: ignore[attr-defined]
        made.config = lambda: _Config(self)  # type: ignore[attr-defined]
        made.align = _Align  # type: ignore[attr-defined]
        return made

    def intrinsics(self) -> SimpleNamespace:
        c = self.room.camera
        return SimpleNamespace(
            width=c.width, height=c.height, fx=c.fx, fy=c.fy, ppx=c.cx, ppy=c.cy, model=self.model,
            coeffs=self.coefficients,
        )  # fmt: skip


class _Config:
    def __init__(self, device: Device) -> None:
        self.device = device

    def enable_device(self, serial: str) -> None:
        self.device.serial = serial

    def enable_stream(self, kind: Any, *mode: Any) -> None:
        width, height, pixels, framerate = mode
        self.device.asked.append((kind.name, width, height, pixels.name, framerate))


class _Pipeline:
    def __init__(self, device: Device) -> None:
        self.device, self.waited = device, 0

    def start(self, config: _Config) -> Any:
        if not self.device.plugged_in:
            raise RuntimeError("No device connected")
        self.device.started += 1
        sensor = SimpleNamespace(get_depth_scale=lambda: self.device.scale_m)
        sensors = [SimpleNamespace(get_stream_profiles=lambda: [_Profile(self.device, stream.color)])]
        sensors += [self.device.motion] if self.device.motion else []
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor, query_sensors=lambda: sensors),
            get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: _Profile(self.device, kind)),
        )

    def stop(self) -> None:
        assert self.device.started > self.device.stopped, "stop() cannot be called before start()"
        self.device.stopped += 1

    def wait_for_frames(self, timeout_ms: int = 5000) -> "_Frames":
        device = self.device
        if device.number >= device.frames_until_unplugged:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        self.waited += 1
        if self.waited % (device.repeats + 1) == 0:
            device.number += 1 + device.missed_between
        device.on_frame(device.number)
        if device.motion:
            device.motion.deliver(device.number / 30.0)
        return _Frames(device, device.number)


class _Profile:
    """A stream of a camera. Depth is rendered from the colour camera, so that aligning does not change it."""

    def __init__(self, device: Device, kind: Any) -> None:
        self.device, self.kind = device, kind

    def format(self) -> Any:
        return format_.rgb8

    def stream_type(self) -> Any:
        return self.kind

    def get_intrinsics(self) -> SimpleNamespace:
        return self.device.intrinsics()

    def get_extrinsics_to(self, other: "_Profile") -> SimpleNamespace:
        return extrinsics(np.eye(3))


def extrinsics(R: np.ndarray, translation: tuple[float, ...] = (0.0, 0.0, 0.0)) -> SimpleNamespace:
    """Return what `get_extrinsics_to` returns: the rotation is stored by columns."""
    return SimpleNamespace(rotation=R.T.reshape(-1).tolist(), translation=list(translation))


class MotionSensor:
    """The motion module: what it measures, in which axes, by which clock, and what goes wrong.

    R_camera_imu: rotation from its axes to those of the colour camera; angular_velocity, specific_force: functions of
    time, along the axes of that camera; late_s: how late samples arrive.
    """

    def __init__(self, R_camera_imu: np.ndarray) -> None:
        self.R_camera_imu = R_camera_imu
        self.angular_velocity: Callable[[float], Any] = lambda time_s: (0.0, 0.0, 0.0)
        self.specific_force: Callable[[float], Any] = lambda time_s: (0.0, -9.81, 0.0)
        self.clock: Callable[[float], Any] = lambda time_s: clock.global_time
        self.late_s = self.ahead_s = 0.0
        self.rates_hz = {stream.gyro: (400, 200), stream.accel: (63, 250)}
        self.opened: list[Any] = []
        self.callback: Callable[[Any], None] | None = None
        self.calls: list[str] = []
        self.failing: dict[str, Exception] = {}
        self.before_delivery: Callable[[float], None] = lambda time_s: None
        self._sent: dict[Any, int] = {}

    def get_stream_profiles(self) -> list["_MotionProfile"]:
        self._call("get_stream_profiles")
        motions = [(format_.combined_motion, stream.gyro, 200)]
        motions += [(format_.motion_xyz32f, kind, hz) for kind, rates in self.rates_hz.items() for hz in rates]
        return [_MotionProfile(self, *motion) for motion in motions]

    def open(self, profiles: list["_MotionProfile"]) -> None:
        assert not self.opened, "Hid device is already opened!"
        self._call("open")
        self.opened = list(profiles)

    def start(self, callback: Callable[[Any], None]) -> None:
        assert self.opened and self.callback is None, "start_streaming(...) failed. Hid device was not opened!"
        self._call("start")
        self.callback = callback

    def stop(self) -> None:
        assert self.callback is not None, "stop_streaming() failed. Hid device is not streaming!"
        self._call("stop")
        self.callback = None

    def close(self) -> None:
        self._call("close")
        if not self.opened or self.callback:
            raise RuntimeError("close() failed. Hid device is streaming!")
        self.opened = []

    def _call(self, name: str) -> None:
        self.calls.append(name)
        if name in self.failing:
            raise self.failing[name]

    def deliver(self, until_s: float) -> None:
        """Call the callback with the samples that have arrived at a time."""
        self.before_delivery(until_s)
        for profile in self.opened if self.callback else []:
            first, kind, hz = self._sent.get(profile.kind, 0), profile.kind, profile.hz
            self._sent[kind] = max(first, int(np.floor((until_s - self.late_s) * hz + 1e-6)) + 1)
            for k in range(first, self._sent[kind]):
                self.send(profile, k / hz)

    def send(self, profile: "_MotionProfile", time_s: float) -> None:
        """Call the callback with the sample of a time."""
        measured = self.angular_velocity if profile.kind is stream.gyro else self.specific_force
        value = np.asarray(measured(time_s), np.float64)
        x, y, z = self.R_camera_imu.T @ value if np.isfinite(value).all() else value
        sample = SimpleNamespace(
            get_motion_data=lambda: SimpleNamespace(x=x, y=y, z=z), get_profile=lambda: profile,
            get_timestamp=lambda: 1000.0 * (time_s + self.ahead_s - EARLIER_S[self.clock(time_s)]),
            get_frame_timestamp_domain=lambda: self.clock(time_s),
        )  # fmt: skip
        if self.callback:
            self.callback(SimpleNamespace(as_motion_frame=lambda: sample))


class _MotionProfile:
    def __init__(self, sensor: MotionSensor, format_: Any, kind: Any, hz: int) -> None:
        self.sensor, self._format, self.kind, self.hz = sensor, format_, kind, hz

    def format(self) -> Any:
        return self._format

    def stream_type(self) -> Any:
        return self.kind

    def fps(self) -> int:
        return self.hz

    def get_extrinsics_to(self, other: _Profile) -> SimpleNamespace:
        self.sensor._call("get_extrinsics_to")
        return extrinsics(self.sensor.R_camera_imu, (0.01, -0.005, 0.012))


class _Align:
    def __init__(self, to: Any) -> None:
        assert to is stream.color

    def process(self, frames: "_Frames") -> "_Frames":
        return _Frames(frames.device, frames.number, aligned=True)


class _Frames:
    def __init__(self, device: Device, number: int, aligned: bool = False) -> None:
        self.device, self.number, self.aligned = device, number, aligned

    def get_color_frame(self) -> Any:
        return self._frame(np.rint(self.device.seen(self.number).color * 255).astype(np.uint8))

    def get_depth_frame(self) -> Any:
        assert self.aligned or not self.device.must_align, "depth is aligned to colour only after align.process()"
        return self._frame(np.rint(self.device.seen(self.number).depth_m / self.device.scale_m).astype(np.uint16))

    def _frame(self, data: np.ndarray) -> Any:
        kind = self.device.clock(self.number)
        milliseconds = 1000.0 * (self.number / 30.0 - EARLIER_S[kind])
        return SimpleNamespace(
            get_data=lambda: data, get_timestamp=lambda: milliseconds, get_frame_number=lambda: self.number,
            get_frame_timestamp_domain=lambda: kind,
        )  # fmt: skip
