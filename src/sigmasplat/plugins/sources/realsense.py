"""Read frames from a live Intel RealSense camera through its SDK, pyrealsense2 (Apache-2.0).

"realsense" or "realsense:width=848,height=480,fps=30,serial=012345678901". Intrinsics, lens distortion and depth unit
come from the device. The SDK moves depth to the colour camera's pixels, but keeps the distances along the axis of the
depth camera, which differ by some millimetres.
"""

import itertools
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Camera, Frame, InputConfig, SourceError
from sigmasplat.plugins.sources.live import LiveSource

OPTIONS = {"width": 640, "height": 480, "fps": 30}
TIMEOUT_MS = 5000
WARM_UP_FRAMES = 15
"""Number of first frames to skip, until the exposure is stable."""


class RealSense(LiveSource):
    """A RealSense camera that is running."""

    def __init__(self, sdk: Any, pipeline: Any, profile: Any, settings: InputConfig) -> None:
        """Read the calibration. Raises SourceError if the settings need more than the camera provides."""
        color = profile.get_stream(sdk.stream.color).as_video_stream_profile()
        camera, lens = _optics(sdk, color.get_intrinsics())
        units = round(1.0 / float(profile.get_device().first_depth_sensor().get_depth_scale()), 3)
        recorded, size = api.Calibration(camera, units, lens), (camera.width, camera.height)
        calibration = api.resolve_calibration(Path("realsense"), recorded, size, settings, units)
        self._rectified = api.Rectification("realsense", calibration, replace(settings, register_depth="off"))
        super().__init__("realsense", self._rectified.camera, settings)
        self._units = calibration.depth_units_per_metre
        self.depth_units_per_metre, self._align, self._pipeline = self._units, sdk.align(sdk.stream.color), pipeline
        self._stop = weakref.finalize(self, pipeline.stop)

    def captured(self) -> Iterator[Frame]:
        """Yield the newest frame repeatedly. Raises SourceError if no frame arrives at all."""
        last: int | None = None
        index = 0
        try:
            for frames in self._framesets():
                both = self._align.process(frames)
                color, depth = both.get_color_frame(), both.get_depth_frame()
                # If only one of both is new, the SDK repeats the other one.
                if not color or not depth or color.get_frame_number() == last:
                    continue
                number = color.get_frame_number()
                self.dropped += max(number - last - 1, 0) if last is not None else 0
                last = number
                pixels = api.color_from_bytes(np.array(color.get_data(), np.uint8))
                units = np.asarray(depth.get_data()).astype(np.float32)
                rgb, depth_m = self._rectified(pixels, units / np.float32(self._units))
                rgb = api.resized_color(rgb, self.camera.width, self.camera.height)
                yield Frame(index, float(color.get_timestamp()) / 1000.0, rgb, depth_m, self.camera)
                index += 1
        finally:
            self._stop()

    def _framesets(self) -> Iterator[Any]:
        for count in itertools.count():
            try:
                frames = self._pipeline.wait_for_frames(TIMEOUT_MS)
            except RuntimeError as error:
                problem = f"{self.name}: no frame for {TIMEOUT_MS / 1000:g} s ({error}); is the camera plugged in?"
                if count <= WARM_UP_FRAMES:
                    raise SourceError(problem) from error
                self.ending = problem
                return
            if count >= WARM_UP_FRAMES:
                yield frames


def open_realsense(text: str, settings: InputConfig) -> RealSense:
    """Start the camera. Raises SourceError if the SDK or camera is missing, or the stream mode is not supported."""
    options = _parsed(text)
    sdk = api.import_optional("pyrealsense2", "realsense", "the RealSense camera")
    pipeline, wanted = sdk.pipeline(), sdk.config()
    if options["serial"]:
        wanted.enable_device(options["serial"])
    width, height, fps = (options[key] for key in OPTIONS)
    wanted.enable_stream(sdk.stream.depth, width, height, sdk.format.z16, fps)
    wanted.enable_stream(sdk.stream.color, width, height, sdk.format.rgb8, fps)
    try:
        profile = pipeline.start(wanted)
    except RuntimeError as error:
        raise SourceError(
            f"no RealSense camera provides {width}×{height} at {fps} frames/s ({error}); plug it into a USB 3 port, "
            "close other programs that use it, or try realsense:width=848,height=480,fps=30"
        ) from error
    try:
        return RealSense(sdk, pipeline, profile, settings)
    except BaseException:
        pipeline.stop()
        raise


def _parsed(text: str) -> dict[str, Any]:
    options: dict[str, Any] = {**OPTIONS, "serial": ""}
    for part in filter(None, text.partition(":")[2].split(",")):
        key, _, value = (word.strip() for word in part.partition("="))
        wrong = key in OPTIONS and not (value.isdecimal() and int(value))
        if key not in options or not value or wrong:
            raise SourceError(f"realsense: unknown option {part!r}; the options are {', '.join(options)}")
        options[key] = value if key == "serial" else int(value)
    return options


def _optics(sdk: Any, intrinsics: Any) -> tuple[Camera, api.Distortion | None]:
    """Return intrinsics and distortion in OpenCV's order; the SDK's three Brown–Conrady models are equal (rsutil.h)."""
    i = intrinsics
    camera = Camera(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy)
    values = tuple(float(v) for v in intrinsics.coeffs)
    known = (sdk.distortion.brown_conrady, sdk.distortion.inverse_brown_conrady, sdk.distortion.modified_brown_conrady)
    if not any(values):
        return camera, None
    if intrinsics.model not in known:
        raise SourceError(
            f"realsense: lens model {intrinsics.model} of the camera is not supported; give --calibration FILE"
        )
    return camera, values


PLUGIN = api.SourceFormat(
    "RealSense", "the word 'realsense', for the camera", lambda path: path.partition(":")[0] == "realsense",
    open_realsense,
)  # fmt: skip
