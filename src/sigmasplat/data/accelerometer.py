"""Measurements of an accelerometer that moves with the camera, and the vertical direction of the world from them."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.sensor_samples import RecentSamples, in_time_order
from sigmasplat.types import Matrix

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
    if not len(times) or not _is_gravity(float(np.median(np.linalg.norm(forces, axis=1)))):
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


def _is_gravity(length_m_s2: float) -> bool:
    return abs(length_m_s2 / GRAVITY_M_S2 - 1.0) <= OFF_GRAVITY


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
