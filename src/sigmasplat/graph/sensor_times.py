"""Measure when the sensor reads depth and rows, from pairs of keyframes that see the same (`sensor_fit`).

Late depth contradicts colour where the camera changes its speed, and rows that are read one after another bend an image
where it moves.
"""

from collections.abc import Sequence

import numpy as np

from sigmasplat.data.readout import UNKNOWN_TIMES, SensorTimes
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.sensor_fit import Fit, Pair, Parameters, fitted
from sigmasplat.types import Task

FIRST_MEASURED, MOST_MEASURED = 60, 60
"""Alignments before the first measurement, and pairs of one."""


def read(pair: Pair, times: SensorTimes) -> tuple[Pyramid, Pyramid]:
    """Return the images of a pair as a sensor with these times has read them."""
    return pair.reference.read(times.read(pair.of_reference)), pair.live.read(times.read(pair.of_live))


TIMES = Parameters(np.full(3, 0.01), lambda pair, s: read(pair, SensorTimes(*s.tolist(), std_s=(0.0, 0.0, 0.0))))
"""Depth after colour, read-out of depth, and of colour, s. In 10 ms, images of a hand-held camera move by some pixels;
the longest step is the time of one frame."""


def measured(pairs: Sequence[Pair]) -> Task[SensorTimes]:
    """Measure the times, in slices of one pair and round.

    Returns all zero, without standard deviations, if the images do not show that anything is read late. The images of a
    pair may be small: half of the working size takes a quarter of the time and gives the same times.
    """
    fit = yield from fitted(pairs, TIMES)
    return times_of(fit) if fit.sure else UNKNOWN_TIMES


def times_of(fit: Fit) -> SensorTimes:
    """Return the times where the pairs agree best; unknown if they are neither sure nor refuted."""
    return UNKNOWN_TIMES if fit.std is None else SensorTimes(*fit.values.tolist(), std_s=tuple(fit.std.tolist()))
