"""benchmarks/search_cost.py: the pairs of a small recording, and the table of their ratios."""

import importlib

from benchmark_results import laid_out

search_cost = importlib.import_module("search_cost")


def test_ratios_are_those_of_pairs() -> None:
    pairs = [
        {"off": {"wall_s": off, "processor_s": 2 * off}, "on": {"wall_s": on, "processor_s": 2 * off}}
        for off, on in ((1.0, 1.1), (2.0, 2.08), (4.0, 4.0))
    ]
    figures = {"recordings": [{"source": "room", "frames": 7, "pairs": pairs}]}
    tables = laid_out("search_cost", figures, config={"pairs": 3})
    wall, processor = tables["Cost of the search where nothing moves"].rows
    assert list(wall) == ["room", "7", "wall clock", "2.00", "2.08", "1.040 (1.000 – 1.100)"]
    assert processor[-1] == "1.000 (1.000 – 1.000)"


def test_all_frames_run_with_and_without_the_search() -> None:
    options = search_cost.Options(pairs=2, settings=("mapping.iterations=1", "mapping.first_iterations=2"))
    found = search_cost.measure_source("synthetic:frames=4,width=64,height=48", options)
    assert found["frames"] == 4 and len(found["pairs"]) == 2
    assert all(seconds > 0 for pair in found["pairs"] for clocks in pair.values() for seconds in clocks.values())
    assert all(set(pair) == {"on", "off"} for pair in found["pairs"])
