"""What the CUDA backend asks of a device per iteration and per frame: never more than is written here."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

from sigmasplat.plugins.cuda import descent
from stand_in import StandIn

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
gpu_counts: Any = importlib.import_module("gpu_counts")
gpu_works: Any = importlib.import_module("gpu_works")

MOST = {
    "mapping_iteration": (32, 21, 1, 2, 1),
    "tracking_iteration": (22, 10, 0, 0.125, 0),
    "align": (81, 33, 11, 11, 11),
    "sigma, tracked frame": (370, 225, 32, 37, 29),
    "sigma, mapped frame": (1060, 450, 136, 130, 124),
}
"""Kernels, of which torch's, waits, copies, of which from and to pageable memory. Frames: as measured and 4 %, because
rounding decides how often a pose is refined."""


def test_no_more_is_asked_than_today(stand_in: StandIn, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descent, "repeatable", lambda work, device: work)
    for name in ("ITERATIONS", "TRACKING_ITERATIONS"):
        monkeypatch.setattr(gpu_works, name, getattr(gpu_works, name))
    rows = {
        row.pop("part"): row
        for row in gpu_counts.count_all(stand_in, gpu_counts.Options(quick=True, presets=("sigma",)))
    }
    assert rows.keys() == MOST.keys()
    for part, row in rows.items():
        assert all(found <= most for found, most in zip(row.values(), MOST[part], strict=True)), (part, row, MOST[part])
