"""When a sensor reads its images, and how its camera moves meanwhile."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sigmasplat.data.poses import Part, Records
from sigmasplat.types import Matrix


@dataclass(frozen=True)
class SensorTimes:
    """When a sensor reads depth and rows, s: depth after colour, beyond what the files say; and how long depth and
    colour take from the first row to the last (rolling shutter). std_s: standard deviations of all three, None: nothing
    is measured, and all is taken as read at once."""

    depth_late_s: float = 0.0
    depth_rows_s: float = 0.0
    color_rows_s: float = 0.0
    std_s: tuple[float, float, float] | None = None

    @staticmethod
    def of(noted: Mapping[str, Any]) -> "SensorTimes":
        """Return times that `noted` has written."""
        late_s, depth_s, color_s = (float(noted[name]) for name in ("depth_late_s", "depth_rows_s", "color_rows_s"))
        std_s = tuple(float(value) for value in noted["std_s"])
        return SensorTimes(late_s, depth_s, color_s, (std_s[0], std_s[1], std_s[2]))

    def noted(self) -> dict[str, Any]:
        """Return the times as facts of a run; nothing if they are not known."""
        return {} if self.std_s is None else {"sensor_times": asdict(self)}

    def said(self) -> str:
        """Return the times in words, empty if they are not known."""
        if self.std_s is None:
            return ""
        late, depth, color = (f"{1e3 * std_s:.0f} ms" for std_s in self.std_s)
        return (
            f"the sensor reads colour in {1e3 * self.color_rows_s:.0f} ± {color}, depth in "
            f"{1e3 * self.depth_rows_s:.0f} ± {depth} and {1e3 * abs(self.depth_late_s):.0f} ± {late} "
            f"{'late' if self.depth_late_s > 0 else 'early'} (corrected)"
        )

    def readout(self, reading: "Reading") -> "Readout | None":
        """Return when the rows of an image were read; None if that is not known, or does not matter at rest."""
        known = self.std_s is not None and reading.rate.any()
        return Readout(reading.rate, reading.late_s, self) if known else None


@dataclass(frozen=True, eq=False)
class Reading:
    """What is particular to one image: the motion of its camera, a twist (v, ω) per second [6] in its axes, and the
    time of depth after colour that the files say, s."""

    rate: Matrix
    late_s: float = 0.0


STILL = Reading(np.zeros(6))
UNKNOWN_TIMES = SensorTimes()


@dataclass(frozen=True, eq=False)
class Readout:
    """When the rows of an image were read, and how its camera moved meanwhile; as `Reading` and `SensorTimes`. The pose
    of the image is that of the camera in the middle of its colour."""

    rate: Matrix
    late_s: float
    times: SensorTimes

    @property
    def numbers(self) -> list[float]:
        """Return the numbers [9] in the order of the kernels' `Readout`."""
        t = self.times
        return [*self.rate.tolist(), self.late_s + t.depth_late_s, t.depth_rows_s, t.color_rows_s]

    def depth_s(self, row: Matrix, height: int) -> Matrix:
        """Return when the depth at some rows of an image was read, s after the middle of its colour."""
        late_s = self.late_s + self.times.depth_late_s
        return late_s + self.times.depth_rows_s * ((row + 0.5) / height - 0.5)

    def color_s(self, row: Matrix, height: int) -> Matrix:
        """Return when the colour at some rows was read, as `depth_s`."""
        return self.times.color_rows_s * ((row + 0.5) / height - 0.5)


AT_ONCE = Readout(np.zeros(6), 0.0, UNKNOWN_TIMES)


def readouts(reference: Readout | None, live: Readout | None) -> list[float]:
    """Return the numbers [18] of two images for the kernels; none if all rows of both were read at once."""
    return [] if reference is live is None else [*(reference or AT_ONCE).numbers, *(live or AT_ONCE).numbers]


@dataclass(eq=False)
class Readings(Records[Reading]):
    """The readings of all keyframes, submap by submap."""

    rate = Part(np.float64, 6)
    late_s = Part(np.float64)

    def append(self, reading: Reading) -> None:
        """Append the reading of the next keyframe."""
        self.add(reading.rate, reading.late_s)

    def _record(self, i: int) -> Reading:
        return Reading(*self.values(i))
