"""Check the times of a recording: unit, order, and gaps."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source

PLAUSIBLE_RATE_HZ = (0.1, 1000.0)
"""Frame rates of cameras, also of recordings that keep every tenth frame; with times in another unit it is outside."""
GAP_S = 1.0
GAP_STEPS = 10.0
"""A gap is longer than `GAP_S` and than this multiple of the median step."""


def times_of(source: Source) -> NDArray[np.float64]:
    """Return the times of all frames whose files can be read, seconds [N]."""
    times = []
    for i in range(len(source)):
        try:
            times.append(source.timestamp_s(i))
        except SourceError:
            continue  # reported when the frame is read
    return np.array(times)


def time_warnings(times_s: NDArray[np.float64]) -> list[str]:
    """Return warnings about the times of the frames, seconds [N]; [] if they are plausible."""
    steps_s = np.diff(times_s)
    if not len(steps_s):
        return []
    warnings = []
    backward = np.flatnonzero(steps_s <= 0)
    if len(backward):
        warnings.append(
            f"{len(backward)} frames have the same time as the frame before, or an earlier one (first: frame "
            f"{backward[0] + 1} at {times_s[backward[0] + 1]:.3f} s); correct the times"
        )
    middle_s = float(np.median(steps_s))
    low, high = PLAUSIBLE_RATE_HZ
    if middle_s > 0 and not low <= 1.0 / middle_s <= high:
        warnings.append(f"the times give {1.0 / middle_s:.3g} frames per second; write times in seconds")
        return warnings
    gaps = np.flatnonzero(steps_s > max(GAP_S, GAP_STEPS * middle_s))
    if len(gaps):
        longest = int(gaps[steps_s[gaps].argmax()])
        warnings.append(
            f"{len(gaps)} gaps in time (longest: {steps_s[longest]:.1f} s after frame {longest}); tracking may be "
            "lost there: use one part with --start and --end"
        )
    return warnings
