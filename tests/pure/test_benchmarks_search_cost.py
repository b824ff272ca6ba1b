"""The table of benchmarks/search_cost.py."""

from benchmark_results import laid_out


def test_ratios_are_those_of_pairs() -> None:
    pairs = [
        {"off": {"wall_s": off, "processor_s": 2 * off}, "on": {"wall_s": on, "processor_s": 2 * off}}
        for off, on in ((1.0, 1.1), (2.0, 2.08), (4.0, 4.0))
    ]
    figures = {"recordings": [{"source": "room", "frames": 7, "pairs": pairs}]}
    wall, processor = laid_out("search_cost", figures, config={"pairs": 3})[
        "Cost of the search where nothing moves"
    ].rows
    assert list(wall) == ["room", "7", "wall clock", "2.00", "2.08", "1.040 (1.000 – 1.100)"]
    assert processor[-1] == "1.000 (1.000 – 1.000)"
