"""Sum up the viewer's memory by fifths of the time, and hold the last one against the second (issue 7)."""

from typing import Any

import numpy as np
from tables import Section, significant

MINUTES, LARGER = 10.0, 0.05
"""Issue 7: flat over ten minutes of live updates."""


def fifths(samples: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return of each fifth of the samples when it ended, s, and its resident memory, MiB."""
    parts = [part for part in np.array_split(np.arange(len(samples)), 5) if len(part)]
    return [
        {
            "until_s": samples[part[-1]]["s"],
            "median_mib": float(np.median([samples[i]["resident_mib"] for i in part])),
            "most_mib": max(samples[i]["resident_mib"] for i in part),
            "in_use_mib": float(np.median([samples[i]["in_use_mib"] for i in part])),
            "clients": min(samples[i]["clients"] for i in part),
        }
        for part in parts
    ]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by viewer_memory.py."""
    figures = measured["figures"]
    parts = fifths(figures["samples"])
    rows = [
        [
            f"{p['until_s']:.0f} s",
            *(significant(p[f"{n}_mib"]) for n in ("median", "most", "in_use")),
            f"{p['clients']:.0f}",
        ]
        for p in parts
    ]
    note = (
        f"{figures['updates']} updates of a run of {figures['frames']} frames, {figures['keyframes']} keyframes, "
        f"{figures['submaps']} submaps."
    )
    second, last = parts[min(1, len(parts) - 1)], parts[-1]
    kinds = {"resident memory": "median_mib", "memory in use": "in_use_mib"}
    ratios = {name: last[kind] / second[kind] for name, kind in kinds.items()}
    clients = min(p["clients"] for p in parts[1:] or parts)
    held = [
        ["minutes", significant(figures["minutes"]), f"≥ {MINUTES:.0f}", _yes(figures["minutes"] >= MINUTES)],
        *(
            [f"{name}, last fifth / second", significant(ratio, 4), f"≤ {1 + LARGER:.2f}", _yes(ratio <= 1 + LARGER)]
            for name, ratio in ratios.items()
        ),
        ["clients, least", f"{clients:.0f}", "≥ 1", _yes(clients >= 1)],
    ]
    return [
        Section("Memory", ["until", "MiB, median", "… most", "in use, median", "clients, least"], rows, note),
        Section("Goals", ["", "found", "goal", "held"], held),
    ]


def _yes(held: bool) -> str:
    return "yes" if held else "**no**"
