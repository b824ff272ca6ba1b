"""Pair two lists of timestamps."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError

Times = NDArray[np.float64]

MAX_GAP_S = 0.02
"""Largest time difference of a colour and a depth image of one camera at 30 Hz; TUM's own tool uses the same."""

UNIT_RATIO = 200.0
"""Median steps of two lists that differ by this factor are in different units, such as s and ms."""


MOST_CANDIDATES = 100
"""Largest mean number of images that may be within the tolerance of an image: a camera of 1000 Hz has 40. Equal times
would need memory for the square of the number of images."""


def associate(first_s: Times, second_s: Times, tolerance_s: float = MAX_GAP_S) -> NDArray[np.intp]:
    """Pair timestamps [N] and [M], seconds, that differ by less than `tolerance_s`; return indices [K, 2] by time.

    Every index is used at most once, and the closest pairs are chosen first. The lists may be unsorted. Ties go to the
    earlier entry of the first list, then of the second, so the result does not depend on the sorting algorithm. Raises
    SourceError if so many times are equal that they cannot pair images.
    """
    rows, columns = _candidates(first_s, second_s, tolerance_s)
    gaps_s = np.abs(first_s[rows] - second_s[columns])
    used_first, used_second = np.zeros(len(first_s), bool), np.zeros(len(second_s), bool)
    pairs = []
    for k in np.lexsort((columns, rows, gaps_s)):
        i, j = rows[k], columns[k]
        if not (used_first[i] or used_second[j]):
            used_first[i] = used_second[j] = True
            pairs.append((i, j))
    pairs.sort(key=lambda pair: (first_s[pair[0]], pair[0]))
    return np.array(pairs, np.intp).reshape(-1, 2)


def no_pairs(path: Path, times_s: Mapping[str, Times]) -> SourceError:
    """Return the error for a recording in which no colour image has depth; `times_s` of colour and depth by name."""
    spans = ", ".join(f"{name} {t.min():.3f} … {t.max():.3f} s" for name, t in times_s.items())
    return SourceError(
        f"no colour image of {path} has depth within {MAX_GAP_S:g} s ({spans}); are both from one recording?"
    )


def refuse_other_units(path: Path, times_s: Mapping[str, Times]) -> None:
    """Raise SourceError if the steps of two lists of times differ so much that their units do."""
    steps = {name: float(np.median(np.abs(np.diff(t)))) for name, t in times_s.items() if len(t) > 2}
    if len(steps) < 2 or min(steps.values()) <= 0 or max(steps.values()) < UNIT_RATIO * min(steps.values()):
        return
    found = ", ".join(f"{name} {step:.6g}" for name, step in steps.items())
    raise SourceError(f"{path}: times are in different units (median steps: {found}); write both in seconds")


def nearest_gaps_s(first_s: Times, second_s: Times) -> Times:
    """Return the time from each of the first times to the nearest of the second, seconds [N]."""
    ordered = np.sort(second_s)
    after = np.clip(np.searchsorted(ordered, first_s), 1, max(len(ordered) - 1, 1))
    before, later = ordered[after - 1], ordered[np.minimum(after, len(ordered) - 1)]
    return np.asarray(np.minimum(np.abs(first_s - before), np.abs(first_s - later)))


def _candidates(first_s: Times, second_s: Times, tolerance_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all index pairs that differ by less than the tolerance."""
    order = np.argsort(second_s, kind="stable")
    ordered = second_s[order]
    low = np.searchsorted(ordered, first_s - tolerance_s, "left")
    high = np.searchsorted(ordered, first_s + tolerance_s, "right")
    most = MOST_CANDIDATES * (len(first_s) + len(second_s))
    if (found := int((high - low).sum())) > most:
        raise SourceError(
            f"{len(first_s)} and {len(second_s)} images have {found} pairs of times within {tolerance_s:g} s, so their "
            "times do not pair them; give every image its own time, in seconds"
        )
    rows = np.repeat(np.arange(len(first_s)), high - low)
    starts = np.repeat(low, high - low)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    columns = order[starts + within]
    near = np.abs(first_s[rows] - second_s[columns]) < tolerance_s
    return rows[near], columns[near]
