"""Lay out how two checkouts' kernels compare: least times of all turns, and the ratio turn by turn."""

from typing import Any

import numpy as np
from tables import Section, significant
from versus_works import NAMES


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the table of results written by versus.py."""
    figures, config = measured["figures"], measured["config"]
    header = ["threads", "work", "before, ms", "now, ms", "now / before", "turn by turn, median (least – most)"]
    turns: list[dict[str, Any]] = figures["turns"]
    rows = [
        _row(threads, name, [t for t in turns if t["threads"] == threads])
        for threads in sorted({t["threads"] for t in turns})
        for name in NAMES
    ]
    note = (
        f"Before: commit {str(figures['other'])[:9]}. Least of {config['runs']} runs in each of {len(turns)} turns; "
        f"{config['splats']} splats of {config['source']}, {config['width']} pixels wide."
    )
    return [Section("Beside another checkout", header, rows, note)]


def _row(threads: int, name: str, turns: list[dict[str, Any]]) -> list[str]:
    now, before = (np.array([turn[of][name] for turn in turns]) for of in ("this", "other"))
    ratios = now / before
    spread = " – ".join(significant(float(x), 3) for x in (ratios.min(), ratios.max()))
    return [
        str(threads),
        name,
        *(significant(float(x)) for x in (before.min(), now.min(), now.min() / before.min())),
        f"{significant(float(np.median(ratios)), 3)} ({spread})",
    ]
