"""Read gyroscope and accelerometer of a live RealSense camera, beside the pipeline that delivers its images.

How the SDK behaves, by its source, its maintainers and reports of its users (repository realsenseai/librealsense,
formerly IntelRealSense, if none is named):

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
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import Matrix, RunningAccelerometer, RunningGyroscope, SourceError, se3

WANTED_HZ = 200
"""Of the rates that a sensor offers, the nearest one is used: several samples per image, and few calls of Python."""
WAITING_MOST = 4096
"""Maximum number of samples that wait for the next image, about 10 s; then the oldest are dropped."""
PATIENCE_S = 3.0
"""After this time without a usable sample, the motion module is given up."""


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
        self._unusable: Sample | None = None
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
        """Return what was measured for an image, from the samples that have arrived; those of another clock are left
        out.

        time_s, clock: of the image, which follows the one of the last call.
        """
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
            self._measured_s, self._unusable = time_s, None
            return motion
        self._unusable = samples[-1] if samples else self._unusable
        if time_s - self._measured_s > PATIENCE_S:
            self._given_up, seen = True, self._unusable
            newest = f"the newest is of {seen.time_s:.3f} s, clock {_name(seen.clock)}" if seen else "none arrived"
            self._notes.append(_not_used(
                f"no sample fits the images for {PATIENCE_S:g} s ({newest}; images: {time_s:.3f} s, clock "
                f"{_name(clock)}); update the firmware, or install the SDK with support for metadata"
            ))  # fmt: skip
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
        notes.append(
            _not_used(f"the motion module cannot be opened ({reason}); close other programs that use it, or update its "
                      "firmware")
        )  # fmt: skip
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


def _not_used(reason: str) -> str:
    return f"realsense: gyroscope and accelerometer are not used: {reason}; realsense:imu=0 leaves them out"


def _name(clock: Any) -> str:
    return str(getattr(clock, "name", clock))
