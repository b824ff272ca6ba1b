"""A gyroscope that measures now: its samples are integrated to rotations while they arrive."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.gyroscope import MAX_BIAS_RAD_S, MAX_RAD_S, Gyroscope, still_mean
from sigmasplat.data.sensor_samples import MAX_GAP_S, RecentSamples
from sigmasplat.types import Matrix

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
