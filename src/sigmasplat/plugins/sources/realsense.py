"""Read frames from a live Intel RealSense camera through its SDK, pyrealsense2 (Apache-2.0).

"realsense" or "realsense:width=848,height=480,fps=30,serial=012345678901". Intrinsics, lens distortion and depth unit
come from the device. The SDK moves depth to the colour camera's pixels, but keeps the distances along the axis of the
depth camera, which differ by some millimetres. With input.register_depth=on depth is registered exactly, but slower.
With "realsense:stereo=1" the projector is off, and depth is computed here from the two infrared images. Cameras with a
motion module deliver gyroscope and accelerometer too (`realsense_imu`), without it with "realsense:imu=0".
"""

import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    Calibration,
    Camera,
    Distortion,
    Frame,
    InputConfig,
    Matrix,
    Rectification,
    SourceError,
    SourceFormat,
    color_from_bytes,
    import_optional,
    resized_color,
    resolve_calibration,
)
from sigmasplat.plugins.sources.live import LiveSource
from sigmasplat.plugins.sources.realsense_imu import NOT_MEASURED, MotionModule, open_motion_module
from sigmasplat.plugins.sources.stereo_matching import StereoCameras, StereoMatcher, StereoRectification

Images = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Colour [H, W, 3] and depth in metres [H, W]."""
OPTIONS = {"width": 640, "height": 480, "fps": 30}
SWITCHES = {"stereo": 0, "imu": 1}
TIMEOUT_MS = 5000
WARM_UP_FRAMES = 15
"""Number of first frames to skip, until the exposure is stable."""


class RealSense(LiveSource):
    """A RealSense camera that is running."""

    def __init__(
        self, sdk: Any, pipeline: Any, device: Any, images: "DepthImages | InfraredImages", settings: InputConfig,
        imu: bool,
    ) -> None:  # fmt: skip
        """images: turns what the SDK delivers into colour and depth; imu: whether to read the motion module, if the
        device has one."""
        super().__init__("realsense", images.camera, settings)
        self.depth_units_per_metre = images.depth_units_per_metre
        self.computed_depth, self.depth_noise_per_m = images.computed, images.noise_per_m
        self._images, self._pipeline = images, pipeline
        self._motion = open_motion_module(sdk, device, images.R_camera_sensor, self.notes) if imu else None
        self._stop = weakref.finalize(self, _stop, pipeline, self._motion)

    def captured(self) -> Iterator[Frame]:
        """Yield the newest frame repeatedly. Raises SourceError if no frame arrives at all."""
        last: int | None = None
        index = 0
        try:
            for frames in self._framesets():
                first, second = self._images.pair(frames)
                # If only one of both is new, the SDK repeats the other one.
                if not first or not second or first.get_frame_number() == last:
                    continue
                number = first.get_frame_number()
                self.dropped += max(number - last - 1, 0) if last is not None else 0
                last = number
                rgb, depth_m = self._images.read(first, second)
                time_s, motion = float(first.get_timestamp()) / 1000.0, NOT_MEASURED
                if self._motion is not None:
                    motion = self._motion.at(time_s, first.get_frame_timestamp_domain())
                yield Frame(index, time_s, rgb, depth_m, self.camera, **motion._asdict())
                index += 1
        finally:
            self._stop()

    def _framesets(self) -> Iterator[Any]:
        """Yield sets of frames until no more arrive."""
        count = 0
        while True:
            try:
                frames = self._pipeline.wait_for_frames(TIMEOUT_MS)
            except RuntimeError as error:
                problem = f"{self.name}: no frame for {TIMEOUT_MS / 1000:g} s ({error}); is the camera plugged in?"
                problem += " If so, try realsense:imu=0" if self._motion is not None else ""
                if count <= WARM_UP_FRAMES:
                    raise SourceError(problem) from error
                self.ending = problem
                return
            count += 1
            if count > WARM_UP_FRAMES:
                yield frames


class DepthImages:
    """Colour, and depth that the camera computes: aligned by the SDK, or registered here."""

    computed, noise_per_m = False, None

    def __init__(self, sdk: Any, profile: Any, settings: InputConfig) -> None:
        """Read the calibration. Raises SourceError if the settings need more than the camera provides."""
        scale_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
        color, depth = (
            profile.get_stream(kind).as_video_stream_profile() for kind in (sdk.stream.color, sdk.stream.depth)
        )
        camera, lens = _optics(sdk, color.get_intrinsics())
        recorded = Calibration(camera, round(1.0 / scale_m, 3), lens)
        size = (camera.width, camera.height)
        calibration = resolve_calibration(Path("realsense"), recorded, size, settings, recorded.depth_units_per_metre)
        if settings.register_depth == "on" and not settings.calibration:
            depth_camera, depth_lens = _optics(sdk, depth.get_intrinsics())
            T = _transform(depth.get_extrinsics_to(color))
            calibration = replace(calibration, depth_camera=depth_camera, depth_distortion=depth_lens, T_color_depth=T)
        self._rectified = Rectification("realsense", calibration, settings)
        self.camera = self._rectified.camera
        self.depth_units_per_metre: float | None = calibration.depth_units_per_metre
        self._align, self._color = sdk.align(sdk.stream.color), color

    def R_camera_sensor(self, sensor: Any) -> Matrix:
        """Return the rotation [3, 3] from the axes of another stream's profile to those of the images."""
        return _transform(sensor.get_extrinsics_to(self._color))[:3, :3]

    def pair(self, frames: Any) -> tuple[Any, Any]:
        """Return colour and depth of a set of frames."""
        both = frames if self._rectified.moves_depth else self._align.process(frames)
        return both.get_color_frame(), both.get_depth_frame()

    def read(self, color: Any, depth: Any) -> Images:
        """Return the images of a pair."""
        pixels = color_from_bytes(np.array(color.get_data(), np.uint8))
        units = np.asarray(depth.get_data()).astype(np.float32)
        rgb, depth_m = self._rectified(pixels, units / np.float32(self.depth_units_per_metre or 1.0))
        return resized_color(rgb, self.camera.width, self.camera.height), depth_m


class InfraredImages:
    """The left and the right infrared image, from which depth is computed here (`stereo_matching`)."""

    computed = True

    def __init__(self, sdk: Any, profile: Any, settings: InputConfig) -> None:
        """Read the calibration, and switch off the projector, whose dots move with the camera."""
        left, right = (profile.get_stream(sdk.stream.infrared, side).as_video_stream_profile() for side in (1, 2))
        (camera, lens), (other, other_lens) = (_optics(sdk, stream.get_intrinsics()) for stream in (left, right))
        cameras = StereoCameras(camera, other, _transform(left.get_extrinsics_to(right)), lens, other_lens)
        self._rectification, self._left = StereoRectification.of(cameras), left
        self.camera = self._rectification.camera
        self._matcher = StereoMatcher(self.camera, self._rectification.baseline_m, settings)
        self.depth_units_per_metre: float | None = None
        self.noise_per_m = self._matcher.noise_per_m
        sensor = profile.get_device().first_depth_sensor()
        if sensor.supports(sdk.option.emitter_enabled):
            sensor.set_option(sdk.option.emitter_enabled, 0)

    def R_camera_sensor(self, sensor: Any) -> Matrix:
        """Return the rotation [3, 3] from the axes of another stream's profile to those of the rectified left image."""
        R_left_sensor = _transform(sensor.get_extrinsics_to(self._left))[:3, :3]
        return self._rectification.T_left_rectified[:3, :3].T @ R_left_sensor

    def pair(self, frames: Any) -> tuple[Any, Any]:
        """Return the left and the right image of a set of frames."""
        return frames.get_infrared_frame(1), frames.get_infrared_frame(2)

    def read(self, left: Any, right: Any) -> Images:
        """Return the left image, gray, and its depth."""
        r = self._rectification
        gray = [np.repeat(np.array(image.get_data(), np.uint8)[..., None], 3, axis=2) for image in (left, right)]
        seen = r.left(gray[0])
        return color_from_bytes(seen), self._matcher.depth_and_std_m(seen, r.right(gray[1]))[0]


def open_realsense(text: str, settings: InputConfig) -> RealSense:
    """Start the camera. Raises SourceError if the SDK or camera is missing, or the stream mode is not supported."""
    options = _parsed(text)
    sdk = import_optional("pyrealsense2", "realsense", "the RealSense camera")
    pipeline, wanted = sdk.pipeline(), sdk.config()
    if options["serial"]:
        wanted.enable_device(options["serial"])
    width, height, fps = (options[key] for key in OPTIONS)
    if options["stereo"]:
        for side in (1, 2):
            wanted.enable_stream(sdk.stream.infrared, side, width, height, sdk.format.y8, fps)
    else:
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
        images = (InfraredImages if options["stereo"] else DepthImages)(sdk, profile, settings)
        return RealSense(sdk, pipeline, profile.get_device(), images, settings, bool(options["imu"]))
    except BaseException:
        pipeline.stop()
        raise


def _stop(pipeline: Any, motion: MotionModule | None) -> None:
    """Stop the camera."""
    try:
        if motion is not None:
            motion.stop()
    finally:
        pipeline.stop()


def _parsed(text: str) -> dict[str, Any]:
    """Read the options after the colon. Raises SourceError on an unknown option."""
    options: dict[str, Any] = {**OPTIONS, **SWITCHES, "serial": ""}
    for part in filter(None, text.partition(":")[2].split(",")):
        key, _, value = (word.strip() for word in part.partition("="))
        wrong = (key in OPTIONS and not (value.isdecimal() and int(value))) or (
            key in SWITCHES and value not in ("0", "1")
        )
        if key not in options or not value or wrong:
            raise SourceError(f"realsense: unknown option {part!r}; the options are {', '.join(options)}")
        options[key] = value if key == "serial" else int(value)
    return options


def _optics(sdk: Any, intrinsics: Any) -> tuple[Camera, Distortion | None]:
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


def _transform(extrinsics: Any) -> NDArray[np.float64]:
    """Return the SDK's extrinsics as a 4×4 matrix; the SDK stores the rotation by columns."""
    T = np.eye(4)
    T[:3, :3] = np.array(extrinsics.rotation, np.float64).reshape(3, 3).T
    T[:3, 3] = extrinsics.translation
    return T


PLUGIN = SourceFormat(
    "RealSense", "the word 'realsense', for the camera", lambda path: path.partition(":")[0] == "realsense",
    open_realsense,
)  # fmt: skip
