"""Read frames from a live Intel RealSense camera through its SDK, pyrealsense2 (Apache-2.0).

"realsense" or "realsense:width=848,height=480,fps=30,serial=012345678901". Intrinsics, lens distortion and depth unit
come from the device. The SDK moves depth to the colour camera's pixels, but keeps the distances along the axis of the
depth camera, which differ by some millimetres. With input.register_depth=on depth is registered exactly, but slower.
Cameras with a motion module deliver gyroscope and accelerometer too, without it with "realsense:imu=0".

How the SDK reads a motion module, by its source and reports (realsenseai/librealsense, if no other is named):

- In one pipeline, samples come at the rate of the slowest stream (#3485, #9129), and images or samples may be missing
  (#5628, #6031, #12581). The advice for Python is a second pipeline (#12581). But that makes a second device object,
  which cannot open the motion module of a D435i or D455 while the first one streams (#6404; dimensionalOS/dimos#3670).
- So the motion module of the pipeline's own device is opened as a sensor, as IntelRealSense/realsense-ros opens it
  beside the cameras (realsense2_camera/src/ros_sensor.cpp). The pipeline opens and stops only the sensors of its own
  streams (src/pipeline/pipeline.cpp). The SDK calls the callback of `sensor.start` on a thread of its own.
- On some computers the colour images stop when the motion module is switched on (#10658): realsense:imu=0.
- Units are rad/s and m/s² (src/proc/motion-transform.cpp). Axes are x right, y down, z forward; an upright camera at
  rest measures y = −9.8 (doc/d435i.md). The SDK turns the samples to the axes of the depth camera, and its extrinsics
  lead from there to the other cameras (pull requests #2843, #2983).
- Samples and images have times of one clock of the device (#3524), or of one conversion of it to the host's clock,
  which all sensors of a device share (src/global_timestamp_reader.cpp). Without support for metadata, images have times
  of the host (#3205, #3980). `get_frame_timestamp_domain` tells which; it may change in the first frames.
"""

import math
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
    RunningAccelerometer,
    RunningGyroscope,
    SourceError,
    SourceFormat,
    color_from_bytes,
    import_optional,
    resized_color,
    resolve_calibration,
    se3,
)
from sigmasplat.plugins.sources.live import LiveSource

OPTIONS = {"width": 640, "height": 480, "fps": 30}
TIMEOUT_MS = 5000
WARM_UP_FRAMES = 15
"""Number of first frames to skip, until the exposure is stable."""
WANTED_HZ = 200
"""Of the rates that a sensor offers, the nearest one is used: several samples per image, and few calls of Python."""
WAITING_MOST = 4096
"""Maximum number of samples that wait for the next image, about 10 s; then the oldest are dropped."""
PATIENCE_S = 3.0
"""After this time without a usable sample, the motion module is given up."""
NOT_USED = "realsense: gyroscope and accelerometer are not used: {}; realsense:imu=0 leaves them out"


class Motion(NamedTuple):
    """What was measured for an image: `R_inertial_camera` and `specific_force_m_s2` of `Frame`."""

    R_inertial_camera: Matrix | None = None
    specific_force_m_s2: NDArray[np.float64] | None = None


NOT_MEASURED = Motion()


class Sample(NamedTuple):
    """A sample as the SDK delivers it: kind of stream, seconds, rad/s or m/s² in the sensor's axes, kind of clock."""

    kind: Any
    time_s: float
    values: tuple[float, float, float]
    clock: Any


class MotionModule:
    """The motion module of a running camera. If it stops to be of use, that is noted once, and it is given up."""

    def __init__(
        self, sensor: Any, R_camera_sensor: dict[Any, Matrix], kinds: tuple[Any, Any], notes: list[str]
    ) -> None:
        """R_camera_sensor: the rotation [3, 3] from the axes of each kind of stream to those of the frames; kinds: of
        the gyroscope and of the accelerometer; notes: gets the reason if the module is given up."""
        self._sensor, self._R_camera_sensor, self._notes = sensor, R_camera_sensor, notes
        self._waiting = deque[Sample](maxlen=WAITING_MOST)
        self._gyroscope, self._accelerometer = RunningGyroscope(), RunningAccelerometer()
        self._add = dict(zip(kinds, (self._gyroscope.add, self._accelerometer.add), strict=True))
        self._clock: Any = None
        self._measured_s = 0.0
        self._given_up = False

    def receive(self, frame: Any) -> None:
        """Keep the sample of a frame for the next image, on a thread of the SDK; leave out one that is not finite."""
        if not (motion := frame.as_motion_frame()):
            return
        data, time_s = motion.get_motion_data(), float(motion.get_timestamp()) / 1000.0
        values = (float(data.x), float(data.y), float(data.z))
        if all(map(math.isfinite, (time_s, *values))):
            kind = motion.get_profile().stream_type()
            self._waiting.append(Sample(kind, time_s, values, motion.get_frame_timestamp_domain()))

    def taken(self) -> list[Sample]:
        """Remove and return the samples that wait, in the order of arrival."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def start(self, profiles: list[Any]) -> None:
        """Start the streams. Raises what the SDK raises."""
        self._sensor.open(profiles)
        try:
            self._sensor.start(self.receive)
        except BaseException:
            with suppress(RuntimeError):
                self._sensor.close()
            raise

    def stop(self) -> None:
        """Stop the streams and release the sensor; an unplugged one cannot be stopped."""
        for action in (self._sensor.stop, self._sensor.close):
            with suppress(RuntimeError):
                action()

    def at(self, time_s: float, clock: Any) -> Motion:
        """Return what was measured for an image of this time and clock, from the samples of that clock that have
        arrived."""
        samples = self.taken()
        if self._given_up:
            return NOT_MEASURED
        if clock != self._clock:
            self._clock, self._measured_s = clock, time_s
        for kind, add in self._add.items():
            fitting = [sample for sample in samples if sample.kind == kind and sample.clock == clock]
            if fitting:
                values = np.array([sample.values for sample in fitting]) @ self._R_camera_sensor[kind].T
                add(np.array([sample.time_s for sample in fitting]), values)
        motion = Motion(self._gyroscope.R_inertial_camera(time_s), self._accelerometer.at(time_s))
        if motion.R_inertial_camera is not None or motion.specific_force_m_s2 is not None:
            self._measured_s = time_s
        elif time_s - self._measured_s > PATIENCE_S:
            self._given_up = True
            what = f"for {PATIENCE_S:g} s no sample had the clock of the images"
            remedy = "update the firmware, or install the SDK with support for metadata"
            self._notes.append(NOT_USED.format(f"{what}; {remedy}"))
        return motion


def open_motion_module(
    sdk: Any, device: Any, R_camera_sensor: Callable[[Any], Matrix], notes: list[str]
) -> MotionModule | None:
    """Start the motion module of a device; None if it has none, or if it cannot be started, which is noted: a run goes
    on without it.

    R_camera_sensor: returns the rotation [3, 3] from the axes of a stream's profile to those of the frames.
    """
    try:
        found = _found(sdk, device)
        if found is None:
            return None
        sensor, profiles = found
        axes = {kind: R_camera_sensor(profile) for kind, profile in profiles.items()}
        if not all(se3.is_rotation(R) for R in axes.values()):
            raise SourceError("its axes relative to the camera are not known")
        module = MotionModule(sensor, axes, (sdk.stream.gyro, sdk.stream.accel), notes)
        module.start(list(profiles.values()))
        return module
    except Exception as error:  # whatever the SDK raises
        reason = " ".join(str(error).split())
        remedy = "close other programs that use it, or update its firmware"
        notes.append(NOT_USED.format(f"the motion module cannot be opened ({reason}); {remedy}"))
        return None


def _found(sdk: Any, device: Any) -> tuple[Any, dict[Any, Any]] | None:
    """Return the sensor that has a gyroscope, and the profile of each of its streams; None if no sensor has one."""
    for sensor in device.query_sensors():
        offered = [profile for profile in sensor.get_stream_profiles() if profile.format() == sdk.format.motion_xyz32f]
        profiles = {}
        for kind in (sdk.stream.gyro, sdk.stream.accel):
            rates = [profile for profile in offered if profile.stream_type() == kind]
            if rates:
                profiles[kind] = min(rates, key=lambda profile: (abs(profile.fps() - WANTED_HZ), profile.fps()))
        if sdk.stream.gyro in profiles:
            return sensor, profiles
    return None


class RealSense(LiveSource):
    """A RealSense camera that is running."""

    def __init__(self, sdk: Any, pipeline: Any, profile: Any, settings: InputConfig, imu: bool) -> None:
        """Read the calibration; imu: whether to read the motion module, if the device has one. Raises SourceError if
        the settings need more than the camera provides."""
        device = profile.get_device()
        color = profile.get_stream(sdk.stream.color).as_video_stream_profile()
        calibration = _calibration(sdk, profile, color, settings)
        self._rectified = Rectification("realsense", calibration, settings)
        super().__init__("realsense", self._rectified.camera, settings)
        self._units = calibration.depth_units_per_metre
        self.depth_units_per_metre, self._align, self._pipeline = self._units, sdk.align(sdk.stream.color), pipeline
        self._motion: MotionModule | None = None
        if imu:
            self._motion = open_motion_module(
                sdk, device, lambda sensor: _transform(sensor.get_extrinsics_to(color))[:3, :3], self.notes
            )
        self._stop = weakref.finalize(self, _stop, pipeline, self._motion)

    def captured(self) -> Iterator[Frame]:
        """Yield the newest frame repeatedly. Raises SourceError if no frame arrives at all."""
        last: int | None = None
        index = 0
        try:
            for frames in self._framesets():
                both = frames if self._rectified.moves_depth else self._align.process(frames)
                color, depth = both.get_color_frame(), both.get_depth_frame()
                # If only one of both is new, the SDK repeats the other one.
                if not color or not depth or color.get_frame_number() == last:
                    continue
                number = color.get_frame_number()
                self.dropped += max(number - last - 1, 0) if last is not None else 0
                last = number
                pixels = color_from_bytes(np.array(color.get_data(), np.uint8))
                units = np.asarray(depth.get_data()).astype(np.float32)
                rgb, depth_m = self._rectified(pixels, units / np.float32(self._units))
                rgb = resized_color(rgb, self.camera.width, self.camera.height)
                time_s, motion = float(color.get_timestamp()) / 1000.0, NOT_MEASURED
                if self._motion is not None:
                    motion = self._motion.at(time_s, color.get_frame_timestamp_domain())
                yield Frame(index, time_s, rgb, depth_m, self.camera, **motion._asdict())
                index += 1
        finally:
            self._stop()

    def _framesets(self) -> Iterator[Any]:
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


def open_realsense(text: str, settings: InputConfig) -> RealSense:
    """Start the camera. Raises SourceError if the SDK or camera is missing, or the stream mode is not supported."""
    options = _parsed(text)
    sdk = import_optional("pyrealsense2", "realsense", "the RealSense camera")
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
        return RealSense(sdk, pipeline, profile, settings, bool(options["imu"]))
    except BaseException:
        pipeline.stop()
        raise


def _calibration(sdk: Any, profile: Any, color: Any, settings: InputConfig) -> Calibration:
    camera, lens = _optics(sdk, color.get_intrinsics())
    units = round(1.0 / float(profile.get_device().first_depth_sensor().get_depth_scale()), 3)
    size = (camera.width, camera.height)
    found = resolve_calibration(Path("realsense"), Calibration(camera, units, lens), size, settings, units)
    if settings.register_depth != "on" or settings.calibration:
        return found
    depth = profile.get_stream(sdk.stream.depth).as_video_stream_profile()
    camera, lens = _optics(sdk, depth.get_intrinsics())
    T_color_depth = _transform(depth.get_extrinsics_to(color))
    return replace(found, depth_camera=camera, depth_distortion=lens, T_color_depth=T_color_depth)


def _stop(pipeline: Any, motion: MotionModule | None) -> None:
    try:
        if motion is not None:
            motion.stop()
    finally:
        pipeline.stop()


def _parsed(text: str) -> dict[str, Any]:
    options: dict[str, Any] = {**OPTIONS, "imu": 1, "serial": ""}
    for part in filter(None, text.partition(":")[2].split(",")):
        key, _, value = (word.strip() for word in part.partition("="))
        wrong = (key in OPTIONS and not (value.isdecimal() and int(value))) or (
            key == "imu" and value not in ("0", "1")
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
