"""List what every CUDA kernel uses: registers, spills, shared memory, blocks per multiprocessor.

Needs no device. Writes benchmarks/results/kernels-<machine>.json and prints its tables.

example: python benchmarks/kernels.py --architectures sm_86
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import program
import record
import tyro
from tables import Section

from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.cuda import cubins

arg = tyro.conf.arg
THREADS = 256
TELL = ("--ptxas-options=-v",)


@dataclass(frozen=True)
class Options:
    """List registers, spills and shared memory of every CUDA kernel."""

    architectures: Annotated[tuple[str, ...], arg(help="architectures to compile for")] = ("sm_86", "sm_90")
    quick: Annotated[bool, arg(help="print only, write no results")] = False
    name: Annotated[str, arg(help="name of the results")] = "kernels"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


class Multiprocessor(NamedTuple):
    """Resources of a multiprocessor for blocks (CUDA C++ programming guide, compute capabilities)."""

    shared_kib: int
    threads: int
    blocks: int
    reserved: int = 1024
    """Bytes of shared memory that the system reserves in every block."""


MULTIPROCESSORS = {
    "sm_75": Multiprocessor(64, 1024, 16, 0),
    "sm_80": Multiprocessor(164, 2048, 32),
    "sm_86": Multiprocessor(100, 1536, 16),
    "sm_89": Multiprocessor(100, 1536, 24),
    "sm_90": Multiprocessor(228, 2048, 32),
    "sm_100": Multiprocessor(228, 2048, 32),
    "sm_120": Multiprocessor(100, 1536, 24),
}
REGISTERS = 65536
USED = re.compile(
    r"Compiling entry function '(?P<name>\w+)'.*?(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads"
    r".*?Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)


class Usage(NamedTuple):
    """Resources of one kernel; shared memory per block and spills per thread, in bytes."""

    kernel: str
    registers: int
    spilled: int
    shared: int


def usages(log: str) -> Iterator[Usage]:
    """Read what ptxas reports for each kernel in NVRTC's log."""
    for found in USED.finditer(log):
        shared = re.search(r"(\d+) bytes smem", found["rest"])
        spilled = max(int(found["stores"]), int(found["loads"]))
        yield Usage(found["name"], int(found["registers"]), spilled, int(shared[1]) if shared else 0)


def remarks(log: str) -> str:
    """Return the other lines of the log: warnings."""
    account = re.compile(r"ptxas (info    :|        \.) |\s*$")
    return "\n".join(line for line in log.splitlines() if not account.match(line))


def blocks_held(usage: Usage, architecture: str) -> int:
    """Return how many blocks of the kernel fit on a multiprocessor; a warp's registers come in units of 256."""
    has = MULTIPROCESSORS[architecture]
    of_warp = -(-usage.registers * 32 // 256) * 256
    shared = -(-(usage.shared + has.reserved) // 128) * 128
    by_shared = has.shared_kib * 1024 // shared if shared else has.blocks
    return min(REGISTERS // (of_warp * THREADS // 32), by_shared, has.threads // THREADS, has.blocks)


def figures_of(architecture: str) -> Iterator[dict[str, Any]]:
    """Compile every program for an architecture; yield a row for each kernel."""
    for features in cubins.PROGRAMS:
        for usage in usages(cubins.compiled(features, architecture, TELL).log):
            held = blocks_held(usage, architecture)
            yield {"architecture": architecture, "features": features, **usage._asdict(), "blocks": held}


# ---- tables ----


Rows = list[dict[str, Any]]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by kernels.py."""
    figures = measured["figures"]
    made = dict.fromkeys(row["architecture"] for row in figures["kernels"])
    note = f"NVRTC {figures['compiler']}; spills per thread; blocks of 256 threads that fit on a multiprocessor."
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
    """Merge rows of a kernel that are equal for several feature counts."""
    joined: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        alike = tuple(row[name] for name in ("kernel", "registers", "spilled", "shared", "blocks"))
        joined.setdefault(alike, row | {"counts": []})["counts"].append(row["features"])
    return list(joined.values())


def _cells(row: dict[str, Any]) -> list[str]:
    fits = (cubins.FITTING, cubins.ALIGNING)
    counts = ", ".join(f"{-n} ray" if n < 0 else f"{n}" for n in row["counts"] if n not in fits)
    return [row["kernel"], counts or "–", *(str(row[name]) for name in ("registers", "spilled", "shared", "blocks"))]


def measure(options: Options) -> dict[str, Any]:
    """Compile every kernel for every architecture. Raises SigmaSplatError for an unknown architecture."""
    unknown = set(options.architectures) - set(MULTIPROCESSORS)
    if unknown:
        raise SigmaSplatError(f"no figures for {', '.join(sorted(unknown))}; there are {', '.join(MULTIPROCESSORS)}")
    rows = [row for architecture in options.architectures for row in figures_of(architecture)]
    return {"compiler": cubins.compiler_version(), "kernels": rows}


def main(options: Options) -> int:
    """Compile, write the results, print them; return the exit code."""
    return program.run("kernels", options, measure, write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
