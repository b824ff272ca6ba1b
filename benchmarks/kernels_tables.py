"""Lay out what the compiler says of the CUDA kernels, a table for each architecture."""

from typing import Any

from tables import Section

Rows = list[dict[str, Any]]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by kernels.py."""
    figures = measured["figures"]
    made = dict.fromkeys(row["architecture"] for row in figures["kernels"])
    note = f"NVRTC {figures['compiler']}; spills of a thread; blocks of 256 threads that a multiprocessor holds."
    return [
        _section(architecture, [row for row in figures["kernels"] if row["architecture"] == architecture], note)
        for architecture in made
    ]


def _section(architecture: str, rows: Rows, note: str) -> Section:
    head = ["kernel", "features", "registers", "spilled, B", "shared, B", "blocks"]
    kernels = dict.fromkeys(row["kernel"] for row in rows)
    ordered = [row for kernel in kernels for row in rows if row["kernel"] == kernel]
    return Section(f"Kernels, {architecture}", head, [_cells(row) for row in _merged(ordered)], note)


def _merged(rows: Rows) -> Rows:
    """Join what programs of several feature counts say alike of a kernel."""
    joined: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        alike = tuple(row[name] for name in ("kernel", "registers", "spilled", "shared", "blocks"))
        joined.setdefault(alike, row | {"counts": []})["counts"].append(row["features"])
    return list(joined.values())


def _cells(row: dict[str, Any]) -> list[str]:
    counts = ", ".join(str(count) for count in row["counts"] if count > 0)
    return [row["kernel"], counts or "–", *(str(row[name]) for name in ("registers", "spilled", "shared", "blocks"))]
