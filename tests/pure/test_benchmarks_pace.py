"""The figures of benchmarks/pace.py."""

import importlib

import pytest

from benchmark_results import laid_out

pace = importlib.import_module("pace")


def test_the_first_frame_counts_for_the_rate_but_not_as_the_longest() -> None:
    found = pace.figures_of([5.0, 0.1, 0.3, 0.2], {"wall_s": 8.0, "finish_s": 4.0})
    assert found["frames_per_s"] == pytest.approx(0.5)
    assert found["longest_ms"] == pytest.approx(300.0) and found["median_ms"] == pytest.approx(200.0)
    assert found["final_s"] == 4.0 and found["total_s"] == 12.0


def test_a_run_without_a_final_map_has_no_ratio_of_it() -> None:
    now, before = ([pace.figures_of([1.0, s, s], {"wall_s": s, "finish_s": None})] * 2 for s in (0.1, 0.2))
    figures = {"sequences": [{"sequence": "room", "runs": {"now": now, "before": before}}]}
    rows = {row[0]: row for row in laid_out("pace", figures)["room: pace"].rows}
    assert rows["frames/s"][3] == "2.00" and rows["frames/s"][4] == "2.00, 2.00"
    assert rows["longest frame, ms"][3] == "0.500" and rows["final map, s"][4] == "nan, nan"
