"""The benchmark of long runs in real time: figures of each minute, and which growth its table reports."""

import importlib
from typing import Any

import pytest

from benchmark_results import laid_out

long_live = importlib.import_module("long_live")


def run_of(minutes: int, **changed: Any) -> list[dict[str, float]]:
    """Return the figures by minute of a run that drops each tenth frame of its second minute."""
    frames = 1800 * minutes
    index = [i for i in range(frames) if not (1800 <= i < 3600 and i % 10 == 0)]
    each = {"index": index, "latency_ms": [10.0 + i % 5 for i in index], "lost": [0] * len(index)}
    each |= {name: list(map(change, index)) for name, change in changed.items() if name in each}
    memory = changed.get("resident_mib", lambda i: 500.0)
    samples = [
        {"time_s": i / 30, "resident_mib": memory(i), "files": 8.0, "threads": 4.0, "splats": 1e4}
        for i in range(0, frames, 30)
    ]
    return list(long_live.by_minute(each, samples, frames))


def test_each_minute_counts_its_frames_and_drops() -> None:
    minutes = run_of(4)
    assert [minute["dropped"] for minute in minutes] == [0, 180, 0, 0]
    assert all(minute["p50_ms"] == 12 and minute["worst_ms"] == 14 for minute in minutes)


def test_a_flat_run_has_no_growth_and_one_bad_minute_does_not_change_this() -> None:
    growth = long_live.slopes(run_of(6))
    assert growth and all(value == pytest.approx(0, abs=1e-3) for value in growth.values())


def test_growth_is_found_and_reported() -> None:
    minutes = run_of(6, latency_ms=lambda i: 10.0 + i / 1000, resident_mib=lambda i: 500.0 + i / 20)
    growth = long_live.slopes(minutes)
    assert growth["p50_ms"] > 0.4 and growth["resident_mib"] > 0.4 and growth["files"] == 0
    figures = {
        "source": "room", "frames": 1, "dropped": 180, "lost": 0, "submaps": 2, "loops_tried": 1, "loops_accepted": 1,
        "valid": True, "minutes": minutes, "slopes": growth,
    }  # fmt: skip
    rows = {row[0]: row[-1] for row in laid_out("long_live", figures)["Growth"].rows}
    assert rows["resident memory"] == "**no**" and rows["open files"] == "yes"


def test_a_short_run_has_no_slopes() -> None:
    assert long_live.slopes(run_of(3)) == {}
