"""The benchmarks of the viewer: its memory while a simulated system grows, and how soon a map is seen."""

import importlib
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest

from sigmasplat.plugins.viewer.snapshot import Snapshot
from sigmasplat.plugins.viewer.snapshot_sources import LiveView

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
viewer_memory, first_look = importlib.import_module("viewer_memory"), importlib.import_module("first_look")


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


def test_the_first_look_has_a_row_for_each_run_and_says_when_others_used_the_machine() -> None:
    pages = [
        {"run": run, "shown": shown, "size": size, "splats": 50_000, "ready_s": 3.0, "page_bytes": page,
         "data_bytes": data, "first_s": first_s, "frames_per_s": 4.0}
        for run in ("desk", "kitchen")
        for shown, size, page, data, first_s in (
            ("viewer", (1280, 800), 700_000, 1_600_000, 2.0), ("shared page", (1280, 800), 1_100_000, None, 1.5),
            ("shared page", (390, 844), 1_100_000, None, 1.0),
        )
    ]  # fmt: skip
    measured = {"machine": {"cores": 2}, "figures": {"load_average": 0.1, "pages": pages}}
    [table] = first_look.sections(measured)
    assert [row[0] for row in table.rows] == ["desk", "kitchen"] and "others" not in table.note
    assert table.rows[0][1:7] == ["50,000", "2.30", "1.10", "2.00", "1.50", "1.00"]
    measured["figures"]["load_average"] = 1.5
    assert "others were using the machine" in first_look.sections(measured)[0].note


def test_the_relay_passes_pages_on_and_counts_their_bytes(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_bytes(b"x" * 100_000)
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, first_look.Relay(server.server_port) as relay:
        for each in (server, relay):
            Thread(target=each.serve_forever, daemon=True).start()
        read = urlopen(f"http://127.0.0.1:{relay.server_address[1]}/page.html", timeout=20).read()
        assert len(read) == 100_000 and 100_000 < relay.page_bytes < 101_000 and relay.data_bytes == 0
        for each in (server, relay):
            each.shutdown()
