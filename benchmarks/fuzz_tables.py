"""Tabulate the results of `fuzz.py`."""

from typing import Any

from tables import Section

KINDS = ("refused", "harmless", "traceback", "hang", "memory")


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return how many inputs of each sample ended in each way."""
    figures = measured["figures"]
    rows = [[name, *(str(counts.get(kind, 0)) for kind in KINDS)] for name, counts in figures["samples"].items()]
    total = [f"all {figures['inputs']}", *(str(figures[kind]) for kind in KINDS)]
    heads = ["sample", "refused in one line", "used without harm", "traceback", "above 10 s", "above 1 GB"]
    return [Section("Mutated inputs", heads, [*rows, total])]
