"""Measurements of a gyroscope and an accelerometer that move with the camera, of recordings."""

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


def in_time_order(times_s: Values, values: Values) -> tuple[Values, Values]:
    """Return samples [M] and [M, 3] sorted by time, without repeated times and values that are not finite."""
    finite = np.isfinite(times_s) & np.isfinite(values).all(1)
    times, first = np.unique(times_s[finite], return_index=True)
    return times, values[finite][first]


MAX_RAD_S = 40.0
"""Gyroscopes of phones and cameras measure up to 2000 °/s = 35 rad/s. Larger values are probably in degrees."""
STILL_SAMPLES, STILL_NOISE_RAD_S, MAX_BIAS_RAD_S = 20, 0.01, 0.05
"""A gyroscope is still if its samples of one second vary by less than this (standard deviation): more than the noise of
phones and cameras, less than a hand shakes. A second with fewer samples is not judged. Biases of such gyroscopes are
below 3 °/s; a larger mean is a turn."""


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """Angular velocities over time: timestamps_s [M], increasing, from the clock of the frames;
    angular_velocity_rad_s [M, 3] about the axes of the camera (x right, y down, z forward), by the right-hand rule.

    Raises SourceError on shapes that do not match, fewer than two samples, values that are not finite or above
    `MAX_RAD_S`, or timestamps that do not increase.
    """

    timestamps_s: Values
    angular_velocity_rad_s: Values
    _R_inertial_camera: Values = field(init=False, repr=False)

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

    def measured_any(self, times_s: Values) -> bool:
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


def gyroscope_from_samples(times_s: Values, angular_velocity_rad_s: Values) -> Gyroscope | None:
    """Make a gyroscope of recorded samples [M] and [M, 3] (`in_time_order`), without its bias (`still_bias`); None if
    they are unusable."""
    times, rates = in_time_order(times_s, angular_velocity_rad_s)
    if len(times) < 2 or not rates.any() or np.abs(rates).max() > MAX_RAD_S:
        return None
    return Gyroscope(times, rates - still_bias(times, rates))


def still_bias(times_s: Values, angular_velocity_rad_s: Values) -> Values:
    """Return the bias [3], rad/s: the median over all seconds in which the gyroscope was still; 0 if it never was.

    A slow turn without any shaking looks like a bias. The rotation is only a guess for tracking, so this costs no pose.
    """
    seconds = np.floor(times_s - times_s[0]).astype(np.int64)
    starts = np.flatnonzero(np.diff(seconds, prepend=-1))
    samples = [rates for rates in np.split(angular_velocity_rad_s, starts[1:]) if len(rates) >= STILL_SAMPLES]
    means = [rates.mean(0) for rates in samples if rates.std(0).max() < STILL_NOISE_RAD_S]
    still = [mean for mean in means if np.linalg.norm(mean) < MAX_BIAS_RAD_S]
    return np.median(still, axis=0) if still else np.zeros(3)


GRAVITY_M_S2 = 9.81
WINDOW_S = 0.1
"""The samples up to this long before and after an image are averaged: a hand shakes faster."""
OFF_GRAVITY = 0.2
"""The median length of the samples may differ from gravity by this share; otherwise gravity was removed from them, or
their unit is another one."""
LEAST_FRAMES, LEAST_MEAN = 10, 0.8
"""Length of the mean over a path, relative to gravity. It is shorter if poses and samples do not belong together."""


@dataclass(frozen=True, eq=False)
class Accelerometer:
    """Specific force over time: timestamps_s [M], increasing, from the clock of the frames; specific_force_m_s2 [M, 3]
    along the axes of the camera (x right, y down, z forward). A camera at rest measures 9.81 m/s² upwards."""

    timestamps_s: Values
    specific_force_m_s2: Values
    _sums: Values = field(init=False, repr=False)

    def __post_init__(self) -> None:
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self.specific_force_m_s2, 0)])
        object.__setattr__(self, "_sums", sums)

    def at(self, time_s: float) -> Values | None:
        """Return the mean specific force [3] around a time, m/s²; None if nothing was measured then."""
        first, end = np.searchsorted(self.timestamps_s, (time_s - WINDOW_S, time_s + WINDOW_S))
        return None if first == end else np.asarray((self._sums[end] - self._sums[first]) / (end - first))


def accelerometer_from_samples(times_s: Values, specific_force_m_s2: Values) -> Accelerometer | None:
    """Make an accelerometer of recorded samples [M] and [M, 3] (`in_time_order`); None if they do not measure
    gravity."""
    times, forces = in_time_order(times_s, specific_force_m_s2)
    length_m_s2 = float(np.median(np.linalg.norm(forces, axis=1))) if len(times) else 0.0
    return None if abs(length_m_s2 / GRAVITY_M_S2 - 1.0) > OFF_GRAVITY else Accelerometer(times, forces)


def up_of_path(T_world_camera: Matrix, specific_force_m_s2: Values) -> Values | None:
    """Return the unit vector [3] that points up in the world; None if it cannot be told.

    T_world_camera [N, 4, 4], specific_force_m_s2 [N, 3] of the same frames. The mean acceleration of a camera over a
    path is its change of velocity by the duration, so the mean of the forces in the world is gravity alone.
    """
    if len(specific_force_m_s2) < LEAST_FRAMES:
        return None
    mean = np.einsum("nij,nj->i", T_world_camera[:, :3, :3], specific_force_m_s2) / len(specific_force_m_s2)
    length = float(np.linalg.norm(mean))
    return mean / length if length >= LEAST_MEAN * GRAVITY_M_S2 else None
