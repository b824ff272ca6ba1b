"""The viewer memory benchmark: its simulated system grows like a run, and its tables compare with the goals."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sigmasplat.plugins.viewer.snapshot import Snapshot
from sigmasplat.plugins.viewer.snapshot_sources import LiveView

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
viewer_memory = importlib.import_module("viewer_memory")


def figures(resident_mib: list[float], clients: int = 1, minutes: float = 10.0) -> dict[str, Any]:
    samples = [
        {"s": 5.0 * i, "resident_mib": mib, "in_use_mib": 0.4 * mib, "clients": clients}
        for i, mib in enumerate(resident_mib)
    ]
    return {"minutes": minutes, "frames": 9, "keyframes": 3, "submaps": 1, "updates": 4, "samples": samples}


def held(found: dict[str, Any]) -> list[str]:
    return [row[3] for row in viewer_memory.sections({"figures": found})[1].rows]


def test_the_goals_are_constant_memory_and_a_client_for_ten_minutes() -> None:
    settling = [100.0, 300.0, 400.0, 500.0]
    assert held(figures(settling + [500.0] * 16)) == ["yes"] * 4
    assert held(figures(settling + [500.0 + 5.0 * i for i in range(16)])) == ["yes", "**no**", "**no**", "yes"]
    assert held(figures(settling + [500.0] * 16, clients=0)) == ["yes", "yes", "yes", "**no**"]
    assert held(figures(settling + [500.0] * 16, minutes=2.0)) == ["**no**", "yes", "yes", "yes"]
    parts = viewer_memory.fifths(figures(settling + [500.0] * 16)["samples"])
    assert [p["until_s"] for p in parts] == [15.0, 35.0, 55.0, 75.0, 95.0] and parts[0]["median_mib"] == 350.0


def test_the_simulated_system_is_shown_like_a_real_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
    viewer_memory = importlib.import_module("viewer_memory")
    monkeypatch.setattr(viewer_memory, "SUBMAP_EVERY", 20)
    growing, shown = viewer_memory.Growing(tmp_path / "submaps", 300), list[Snapshot]()
    live = LiveView(growing.slam, shown.append, "growing", budget=500, every_s=0.0, clock=lambda: 1.0)
    for _ in range(50):
        live(growing())
    last = shown[-1]
    assert len(last.path) == 50 and len(last.path.keyframes) == 10 and [p.submap for p in last.pieces] == [0, 1, 2]
    assert max(sum(len(p.field) for p in snapshot.pieces) for snapshot in shown) <= 500
    assert np.flatnonzero(last.path.lost).tolist() == [0]
    assert last.image(0) is not None and last.image(45) is not None
