"""benchmarks/versus.py: ratios of the right things, and never another checkout's code than the one named."""

import importlib
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
versus, versus_works = map(importlib.import_module, ("versus", "versus_works"))


def test_ratios_are_of_least_times_and_turn_by_turn() -> None:
    def of(ms: float) -> dict[str, float]:
        return dict.fromkeys(versus_works.NAMES, ms)

    turns = [
        {"threads": 1, "this": of(8.0), "other": of(10.0)},
        {"threads": 1, "this": of(30.0), "other": of(20.0)},
        {"threads": 1, "this": of(9.0), "other": of(12.0)},
    ]
    config = {"source": "room", "splats": 5, "width": 64, "runs": 3}
    (section,) = versus.sections({"figures": {"other": "a" * 40, "turns": turns}, "config": config})
    assert [row[1] for row in section.rows] == list(versus_works.NAMES)
    assert section.rows[0][2:] == ["10.0", "8.00", "0.800", "0.800 (0.750 – 1.50)"]


def test_a_checkout_without_kernels_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert versus.main(versus.Options(tmp_path, threads=(1,), rounds=1, out=tmp_path)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(tmp_path) in said and "make native" in said
    assert not list(tmp_path.iterdir())
