"""Measurements of a gyroscope and an accelerometer that move with the camera, of recordings and of live cameras."""

from collections import deque
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sigmasplat.errors import SourceError
from sigmasplat.types import Matrix

Values = NDArray[np.float64]

MAX_GAP_S = 0.1
"""Between two samples that are farther apart, nothing was measured."""
KEPT_S = 10.0
"""The samples of a live camera are kept this long: longer than a frame takes."""


def in_time_order(times_s: Values, values: Values) -> tuple[Values, Values]:
    """Return samples [M] and [M, 3] sorted by time, without repeated times and values that are not finite."""
    finite = np.isfinite(times_s) & np.isfinite(values).all(1)
    times, first = np.unique(times_s[finite], return_index=True)
    return times, values[finite][first]


class RecentSamples:
    """The samples of the last `KEPT_S` of a sensor that measures now: times_s [M], increasing, and values [M, 3]."""

    def __init__(self) -> None:
        self.times_s, self.values = np.zeros(0), np.zeros((0, 3))

    def add(self, times_s: Values, values: Values) -> tuple[Values, Values]:
        """Add samples [N] and [N, 3] that arrived since the last call; return those that were added.

        Left out: values that are not finite, and samples that are not later than the newest one. If all of them are
        more than `MAX_GAP_S` earlier, the clock was set back, and the samples so far are discarded.
        """
        times_s, values = in_time_order(times_s, values)
        if len(self.times_s) and len(times_s):
            newest_s = self.times_s[-1]
            if times_s[-1] < newest_s - MAX_GAP_S:
                self.times_s, self.values = np.zeros(0), np.zeros((0, 3))
            else:
                times_s, values = times_s[times_s > newest_s], values[times_s > newest_s]
        all_s, both = np.concatenate([self.times_s, times_s]), np.concatenate([self.values, values])
        kept = slice(int(np.searchsorted(all_s, all_s[-1] - KEPT_S)) if len(all_s) else 0, None)
        self.times_s, self.values = all_s[kept], both[kept]
        return times_s, values


MAX_RAD_S = 40.0
"""Gyroscopes of phones and cameras measure up to 2000 °/s = 35 rad/s. Larger values are probably in degrees."""
STILL_SAMPLES = 20
"""A second with fewer samples is not judged."""
STILL_NOISE_RAD_S = 0.01
"""A gyroscope is still if its samples of one second vary by less than this (standard deviation): more than the noise of
phones and cameras, less than a hand shakes."""
MAX_BIAS_RAD_S = 0.05
"""Biases of such gyroscopes are below 3 °/s; a larger mean is a turn."""


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """Angular velocities over time: timestamps_s [M], increasing, from the clock of the frames;
    angular_velocity_rad_s [M, 3] about the axes of the camera (x right, y down, z forward), by the right-hand rule.

    Raises SourceError on shapes that do not match, fewer than two samples, values that are not finite or above
    `MAX_RAD_S`, or timestamps that do not increase.
    """

    timestamps_s: NDArray[np.float64]
    angular_velocity_rad_s: NDArray[np.float64]
    _R_inertial_camera: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        times_s, rates = self.timestamps_s, self.angular_velocity_rad_s
        if len(times_s) < 2 or rates.shape != (len(times_s), 3):
            raise SourceError(f"gyroscope has {len(times_s)} timestamps but angular velocities of shape {rates.shape}")
        if not (np.isfinite(times_s).all() and np.isfinite(rates).all()):
            raise SourceError("gyroscope: timestamps or angular velocities hold NaN or inf; delete these samples")
        if not (np.diff(times_s) > 0).all():
            k = int(np.argmin(np.diff(times_s) > 0))
            raise SourceError(f"gyroscope: time {times_s[k + 1]} s follows {times_s[k]} s; sort the samples by time")
        if (largest := float(np.abs(rates).max())) > MAX_RAD_S:
            raise SourceError(f"gyroscope: {largest:.1f} rad/s is too fast; convert degrees per second to radians")
        means = 0.5 * (rates[1:] + rates[:-1])
        steps = Rotation.from_rotvec(means * np.diff(times_s)[:, None]).as_matrix()
        object.__setattr__(self, "_R_inertial_camera", np.stack(list(accumulate([np.eye(3), *steps], np.matmul))))

    def measured_any(self, times_s: NDArray[np.float64]) -> bool:
        """Return whether any of the times [N] is between the first and the last sample."""
        return bool(((self.timestamps_s[0] <= times_s) & (times_s <= self.timestamps_s[-1])).any())

    def R_inertial_camera(self, time_s: float) -> Matrix | None:
        """Return the rotation [3, 3] from the camera's axes at a time to its axes at the first sample; None outside the
        samples.

        Between two samples the velocity is interpolated linearly, and its mean is the rotation vector of the step.
        The rotation between two times a and b is R_inertial_camera(a)ᵀ R_inertial_camera(b).
        """
        times_s, rates = self.timestamps_s, self.angular_velocity_rad_s
        if not times_s[0] <= time_s <= times_s[-1]:
            return None
        k = min(int(np.searchsorted(times_s, time_s, "right")), len(times_s) - 1) - 1
        since_s = time_s - times_s[k]
        mean = rates[k] + 0.5 * (rates[k + 1] - rates[k]) * since_s / (times_s[k + 1] - times_s[k])
        return np.asarray(self._R_inertial_camera[k] @ Rotation.from_rotvec(mean * since_s).as_matrix())


def gyroscope_from_samples(
    times_s: NDArray[np.float64], angular_velocity_rad_s: NDArray[np.float64]
) -> Gyroscope | None:
    """Make a gyroscope of recorded samples [M] and [M, 3] (`in_time_order`), without its bias (`still_bias`); None if
    they are unusable."""
    times, rates = in_time_order(times_s, angular_velocity_rad_s)
    if len(times) < 2 or not rates.any() or np.abs(rates).max() > MAX_RAD_S:
        return None
    return Gyroscope(times, rates - still_bias(times, rates))


def still_bias(times_s: NDArray[np.float64], angular_velocity_rad_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bias [3], rad/s: the median over all seconds in which the gyroscope was still; 0 if it never was.

    A slow turn without any shaking looks like a bias. The rotation is only a guess for tracking, so this costs no pose.
    """
    seconds = np.floor(times_s - times_s[0]).astype(np.int64)
    starts = np.flatnonzero(np.diff(seconds, prepend=-1))
    means = [still_mean(rates) for rates in np.split(angular_velocity_rad_s, starts[1:])]
    still = [mean for mean in means if mean is not None]
    return np.median(still, axis=0) if still else np.zeros(3)


def still_mean(angular_velocity_rad_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the mean [3] of the samples [M, 3] of one second, rad/s; None if the gyroscope was not still."""
    rates = angular_velocity_rad_s
    if len(rates) < STILL_SAMPLES or rates.std(0).max() >= STILL_NOISE_RAD_S:
        return None
    mean: NDArray[np.float64] = rates.mean(0)
    return mean if np.linalg.norm(mean) < MAX_BIAS_RAD_S else None


MOST_LATE_S = 0.03
"""Samples may arrive this much later than the image: until then the newest velocity is taken to continue."""
MOST_STILL_SECONDS = 600
"""The bias is that of the newest seconds at rest, because it changes when the sensor warms up."""


class RunningGyroscope:
    """Rotations of the camera from the samples so far, about its axes, by the clock of the frames.

    The rotation between two images is integrated from all samples that have arrived when it is asked for, with the bias
    known by then. Nothing waits for samples that have not arrived.
    """

    def __init__(self) -> None:
        self._recent, self._bias = RecentSamples(), RunningBias()
        self._R_inertial_camera: Matrix = np.eye(3)
        self._time_s: float | None = None

    def add(self, times_s: NDArray[np.float64], angular_velocity_rad_s: NDArray[np.float64]) -> None:
        """Add the samples [N] and [N, 3] that arrived since the last call. Values above `MAX_RAD_S` are left out."""
        slow = np.abs(angular_velocity_rad_s).max(1, initial=0.0) < MAX_RAD_S - MAX_BIAS_RAD_S  # False for nan
        self._bias.add(*self._recent.add(times_s[slow], angular_velocity_rad_s[slow]))

    def R_inertial_camera(self, time_s: float) -> Matrix | None:
        """Return the rotation [3, 3] from the camera's axes at a time to its axes at the first time that was asked for.

        Times are those of images, in their order. None if nothing was measured at this time, or not all the way since
        the image before; the rotation in between is unknown then, and left out of the later ones.
        """
        times_s = self._recent.times_s
        if len(times_s) < 2 or not self._recent.values.any() or not times_s[0] <= time_s <= times_s[-1] + MOST_LATE_S:
            return None
        before_s, self._time_s = self._time_s, time_s
        R_before_now = np.eye(3) if before_s is None else self._turned(before_s, time_s)
        if R_before_now is None:
            return None
        self._R_inertial_camera = self._R_inertial_camera @ R_before_now
        return self._R_inertial_camera

    def _turned(self, begin_s: float, end_s: float) -> Matrix | None:
        """Return the rotation [3, 3] from the camera's axes at the end to those at the begin; None if it is unknown."""
        times_s, rates = self._recent.times_s, self._recent.values
        if not times_s[0] <= begin_s <= end_s:
            return None
        if begin_s == end_s:
            return np.eye(3)
        during = slice(np.searchsorted(times_s, begin_s, "right") - 1, np.searchsorted(times_s, end_s) + 1)
        times_s, rates = times_s[during], rates[during] - self._bias.rad_s
        if times_s[-1] < end_s:
            times_s, rates = np.append(times_s, end_s), np.concatenate([rates, rates[-1:]])
        if np.diff(times_s).max() > MAX_GAP_S:
            return None
        gyroscope = Gyroscope(times_s, rates)
        R_begin, R_end = gyroscope.R_inertial_camera(begin_s), gyroscope.R_inertial_camera(end_s)
        return None if R_begin is None or R_end is None else R_begin.T @ R_end


class RunningBias:
    """The bias of a gyroscope from the seconds so far in which it was still (`still_bias` for a whole recording).

    rad_s [3]: the median over these seconds; 0 until there is one.
    """

    def __init__(self) -> None:
        self.rad_s = np.zeros(3)
        self._still = deque[NDArray[np.float64]](maxlen=MOST_STILL_SECONDS)
        self._second: list[NDArray[np.float64]] = []
        self._begin_s = 0.0

    def add(self, times_s: NDArray[np.float64], angular_velocity_rad_s: NDArray[np.float64]) -> None:
        """Add samples [N] and [N, 3]; each second is judged when the next one begins."""
        for time_s, rate in zip(times_s.tolist(), angular_velocity_rad_s, strict=True):
            if self._second and not 0.0 <= time_s - self._begin_s < 1.0:
                self._judge(np.stack(self._second))
                self._second = []
            if not self._second:
                self._begin_s = time_s
            self._second.append(rate)

    def _judge(self, rates: NDArray[np.float64]) -> None:
        mean = still_mean(rates)
        if mean is not None:
            self._still.append(mean)
            self.rad_s = np.median(self._still, axis=0)


GRAVITY_M_S2 = 9.81
WINDOW_S = 0.1
"""The samples up to this long before and after an image are averaged: a hand shakes faster."""
OFF_GRAVITY = 0.2
"""The median length of the samples may differ from gravity by this share; otherwise gravity was removed from them, or
their unit is another one."""
LEAST_FRAMES = 10
LEAST_MEAN = 0.8
"""Length of the mean over a path, relative to gravity. It is shorter if poses and samples do not belong together."""


@dataclass(frozen=True, eq=False)
class Accelerometer:
    """Specific force over time: timestamps_s [M], increasing, from the clock of the frames; specific_force_m_s2 [M, 3]
    along the axes of the camera (x right, y down, z forward). A camera at rest measures 9.81 m/s² upwards."""

    timestamps_s: NDArray[np.float64]
    specific_force_m_s2: NDArray[np.float64]
    _sums: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self.specific_force_m_s2, 0)])
        object.__setattr__(self, "_sums", sums)

    def at(self, time_s: float) -> NDArray[np.float64] | None:
        """Return the mean specific force [3] around a time, m/s²; None if nothing was measured then."""
        first, end = np.searchsorted(self.timestamps_s, (time_s - WINDOW_S, time_s + WINDOW_S))
        return None if first == end else np.asarray((self._sums[end] - self._sums[first]) / (end - first))


def accelerometer_from_samples(
    times_s: NDArray[np.float64], specific_force_m_s2: NDArray[np.float64]
) -> Accelerometer | None:
    """Make an accelerometer of recorded samples [M] and [M, 3] (`in_time_order`); None if they do not measure
    gravity."""
    times, forces = in_time_order(times_s, specific_force_m_s2)
    length_m_s2 = float(np.median(np.linalg.norm(forces, axis=1))) if len(times) else 0.0
    if abs(length_m_s2 / GRAVITY_M_S2 - 1.0) > OFF_GRAVITY:
        return None
    return Accelerometer(times, forces)


class RunningAccelerometer:
    """An accelerometer that measures now, along the axes of the camera, by the clock of the frames."""

    def __init__(self) -> None:
        self._recent = RecentSamples()

    def add(self, times_s: NDArray[np.float64], specific_force_m_s2: NDArray[np.float64]) -> None:
        """Add the samples [N] and [N, 3] that arrived since the last call."""
        self._recent.add(times_s, specific_force_m_s2)

    def at(self, time_s: float) -> NDArray[np.float64] | None:
        """Return the mean specific force [3] around a time, m/s², of the samples so far; None if nothing was measured
        then, or if the recent samples do not measure gravity."""
        found = accelerometer_from_samples(self._recent.times_s, self._recent.values)
        return None if found is None else found.at(time_s)


def up_of_path(T_world_camera: Matrix, specific_force_m_s2: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit vector [3] that points up in the world; None if it cannot be told.

    T_world_camera [N, 4, 4], specific_force_m_s2 [N, 3] of the same frames. The mean acceleration of a camera over a
    path is its change of velocity by the duration, so the mean of the forces in the world is gravity alone.
    """
    if len(specific_force_m_s2) < LEAST_FRAMES:
        return None
    mean = np.einsum("nij,nj->i", T_world_camera[:, :3, :3], specific_force_m_s2) / len(specific_force_m_s2)
    length = float(np.linalg.norm(mean))
    return mean / length if length >= LEAST_MEAN * GRAVITY_M_S2 else None
