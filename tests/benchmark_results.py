"""Find the benchmarks' programs, and lay out made-up results of theirs."""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))  # they are programs: they find each other beside themselves


def results(benchmark: str, figures: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return figures with the circumstances that a benchmark writes beside them, as they come back from a file."""
    circumstances = {"machine": {"cpu": "Test CPU", "cores": 2}, "commit": "0123456789ab", "dirty": True}
    rest = {"name": benchmark, "date": "2025-01-02T03:04:05+00:00", "config": {}, "command": "python x.py"}
    return {
        "benchmark": benchmark, **circumstances, **rest, "figures": json.loads(json.dumps(figures)), **changes,
    }  # fmt: skip


def laid_out(benchmark: str, figures: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return the tables of results by title; every row is as wide as its head."""
    tables = importlib.import_module("tables")
    made = {section.title: section for section in tables.sections(results(benchmark, figures, **changes))}
    assert all(len(row) == len(section.columns) for section in made.values() for row in section.rows)
    return made
