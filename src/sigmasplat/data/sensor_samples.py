"""Samples of a sensor that moves with the camera, as recordings and live cameras have them."""

import numpy as np
from numpy.typing import NDArray

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
