"""Sum up the long run by quarters, and hold its last one against its second (issue 4)."""

from typing import Any

import numpy as np
from tables import Section, significant

FRAMES, SLOWER, LARGER = 2000, 0.10, 0.15
"""Issue 4: in at least 2000 frames the last quarter's time within 10 %, its memory within 15 % of the second's."""


def quarters(each: dict[str, list[float]]) -> list[dict[str, float]]:
    """Sum up each quarter of the frames: seconds a frame takes, resident memory, submaps there are at its end."""
    parts = {name: np.array_split(np.array(values), 4) for name, values in each.items()}
    return [
        {
            "frames": len(seconds),
            "median_s": float(np.median(seconds)),
            "mean_s": float(seconds.mean()),
            "longest_s": float(seconds.max()),
            "median_mib": float(np.median(resident)),
            "most_mib": float(resident.max()),
            "submaps": int(submap[-1]) + 1,
        }
        for seconds, resident, submap in zip(parts["seconds"], parts["resident_mib"], parts["submap"], strict=True)
    ]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by long_run.py."""
    figures = measured["figures"]
    return [by_quarter(figures), goals(figures)]


def by_quarter(figures: dict[str, Any]) -> Section:
    """Lay out time and memory by quarters."""
    rows = []
    for number, part in enumerate(quarters(figures["each"]), 1):
        times = [1e3 * part[name] for name in ("median_s", "mean_s", "longest_s")]
        cells = [*times, part["median_mib"], part["most_mib"]]
        rows.append([str(number), str(part["frames"]), str(part["submaps"]), *map(significant, cells)])
    head = ["quarter", "frames", "submaps at its end", "ms a frame, median", "… mean", "… longest", "MiB, median"]
    ate_m, finish = figures["ate_m"], figures["finish"]
    note = (
        f"{figures['source']}: lost {figures['lost']}, loops accepted {figures['loops_accepted']} of "
        f"{figures['loops_tried']} tried, ATE {significant(None if ate_m is None else 100 * ate_m)} cm."
    )
    if finish:
        note += f" The final map took {significant(finish['finish_s'])} s, {significant(finish['resident_mib'])} MiB."
    return Section("Quarters", [*head, "… most"], rows, note)


def goals(figures: dict[str, Any]) -> Section:
    """Hold the last quarter against the second; the median frame has no mapping in it, the mean one has."""
    _, second, _, last = quarters(figures["each"])
    rows = [["frames", str(figures["frames"]), f"≥ {FRAMES}", _held(figures["frames"] >= FRAMES)]]
    for what, name, most in (
        ("time of a frame, median", "median_s", SLOWER),
        ("… mean", "mean_s", SLOWER),
        ("resident memory, median", "median_mib", LARGER),
    ):
        ratio = last[name] / second[name]
        rows.append([what, significant(ratio), f"{1 - most:.2f} … {1 + most:.2f}", _held(abs(ratio - 1) <= most)])
    return Section("Goals", ["last quarter over the second", "measured", "goal", "held"], rows)


def _held(yes: bool) -> str:
    return "yes" if yes else "**no**"
