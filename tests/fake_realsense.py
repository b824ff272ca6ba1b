"""A fake pyrealsense2: the part of its interface that is used, filming the synthetic room.

Names, arguments and units as in pyrealsense2 2.59: depth as whole numbers of `get_depth_scale()` metres, times in
milliseconds, frame numbers that increase while no frame is read, RuntimeError if no frame arrives.
"""

from collections.abc import Callable
from enum import Enum
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from sigmasplat.plugins.sources import SyntheticRoom

stream = Enum("stream", "depth color")
format_ = Enum("format", "z16 rgb8")
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
        self.asked: list[tuple[Any, ...]] = []
        self.serial = ""
        self.started = self.stopped = 0
        self.number = 0
        self.on_frame: Callable[[int], None] = lambda number: None
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
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
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
        assert self.aligned, "depth is aligned to colour only after align.process()"
        return self._frame(np.rint(self.device.seen(self.number).depth_m / self.device.scale_m).astype(np.uint16))

    def _frame(self, data: np.ndarray) -> Any:
        return SimpleNamespace(
            get_data=lambda: data, get_frame_number=lambda: self.number,
            get_timestamp=lambda: 1000.0 * (self.number / 30.0),
        )  # fmt: skip
