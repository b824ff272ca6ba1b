"""Check a few depth images before a run for a wrong unit or missing readings."""

from collections.abc import Iterable

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source

PLAUSIBLE_MEDIAN_M = (0.2, 15.0)
"""The median depth of indoor sequences is well inside this range; with a wrong power of ten it is outside."""

KNOWN_UNITS_PER_METRE = {1000.0: "millimetres", 5000.0: "TUM's unit", 6553.5: "Replica's unit", 1.0: "metres"}


def depth_warning(source: Source, samples: int = 5) -> str | None:
    """Return a warning if the depth scale looks wrong, with the median and a suggestion; None if it is plausible.

    It is also None if the source computes depth in metres from a stereo pair, because streets are deeper than rooms,
    and if a network predicts it while frames are read: the first frame has set its scale. The
    median is over all readings of `samples` frames spread evenly; unreadable frames are left out.
    """
    if source.depth_model:
        return None
    medians = _frame_medians_m(source, _spread(len(source), samples))
    if medians and source.computed_depth:
        return None
    if not medians:
        return f"{source.name}: no depth reading in the frames sampled"
    median_m = float(np.median(medians))
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median_m <= high:
        return None
    return (
        f"{source.name}: median depth is {median_m:.4g} m over {len(medians)} frames, outside {low}–{high} m; "
        f"the depth's scale looks wrong{_unit_guess(median_m, source.depth_units_per_metre)}"
    )


def refuse_without_depth(source: Source, samples: int = 5) -> None:
    """Raise SourceError if no frame has a depth reading; reads a few frames, and all frames only if those are blank.
    Nothing is read if a network predicts depth: it has predicted that of the first frame."""
    if source.depth_model or _frame_medians_m(source, _spread(len(source), samples)):
        return
    if not _frame_medians_m(source, range(len(source)), stop_at=1):
        raise SourceError(
            f"{source.name}: depth is zero or unreadable in all {len(source)} frames; "
            f"check the depth files (first problem: {_first_problem(source)})"
        )


def _first_problem(source: Source) -> str:
    try:
        source.depth_of(0)
    except SourceError as error:
        return str(error)
    return "frame 0 has no pixel above 0"


def _spread(count: int, samples: int) -> list[int]:
    return sorted({int(i) for i in np.linspace(0, count - 1, min(samples, count)).round()})


def _frame_medians_m(source: Source, indices: Iterable[int], stop_at: int | None = None) -> list[float]:
    """Return the median reading of each frame that is readable and not blank."""
    medians: list[float] = []
    for i in indices:
        if stop_at is not None and len(medians) >= stop_at:
            break
        try:
            depth_m = source.depth_of(i)
        except SourceError:
            continue  # reported when the source is iterated
        if (depth_m > 0).any():
            medians.append(float(np.median(depth_m[depth_m > 0])))
    return medians


def _unit_guess(median_m: float, units_per_metre: float | None) -> str:
    """Suggest the known unit whose median is nearest to 2 m, typical for indoors."""
    raw = median_m * (units_per_metre or 1.0)
    guesses = {units: raw / units for units in KNOWN_UNITS_PER_METRE if 0.4 <= raw / units <= 8.0}
    if not guesses:
        return "; set depth_scale (PNG units per metre) in calibration.json"
    units = min(guesses, key=lambda u: abs(np.log(guesses[u] / 2.0)))
    name, would_be_m = KNOWN_UNITS_PER_METRE[units], guesses[units]
    return f"; depth_scale {units:g} ({name}) in calibration.json would make it {would_be_m:.2f} m"
