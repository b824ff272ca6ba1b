"""Samples of a sensor that moves with the camera, as recordings have them."""

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


def in_time_order(times_s: Values, values: Values) -> tuple[Values, Values]:
    """Return samples [M] and [M, 3] sorted by time, without repeated times and values that are not finite."""
    finite = np.isfinite(times_s) & np.isfinite(values).all(1)
    times, first = np.unique(times_s[finite], return_index=True)
    return times, values[finite][first]
