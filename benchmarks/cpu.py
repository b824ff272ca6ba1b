"""Time the CPU kernels on maps back-projected from real depth: every operation, instruction set, number of threads.

Writes benchmarks/results/cpu-<machine>.json and prints its tables; benchmarks/README.md says what each figure means.
Do not use the machine for anything else during the measurement.

example: python benchmarks/cpu.py --quick
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tyro

from sigmasplat.errors import SigmaSplatError
from sigmasplat.files.machine import usable_cores

arg = tyro.conf.arg
REFERENCE, QUICK_REFERENCE = 20_000, 4_000
"""Splats that plain torch renders at a width of 80 pixels; it computes every pair and takes seconds."""
SYNTHETIC = "synthetic:frames=200,width=640,height=480"


def default_source() -> str:
    """Return redkitchen if the real data is available, otherwise the built-in room."""
    kitchen = record.data_root() / "redkitchen"
    return str(kitchen) if kitchen.is_dir() else SYNTHETIC


@dataclass(frozen=True)
class Options:
    """Time the CPU kernels on maps back-projected from real depth."""

    source: Annotated[str, arg(help="sequence whose depth becomes splats")] = field(default_factory=default_source)
    frame: Annotated[int, arg(help="frame of the sequence")] = 150
    splats: Annotated[tuple[int, ...], arg(help="sizes of the map")] = (20_000, 77_000, 100_000, 300_000)
    widths: Annotated[tuple[int, ...], arg(help="widths of the image, pixels")] = (320, 640)
    isas: Annotated[tuple[str, ...], arg(help="instruction sets, the main one first (default: all supported)")] = ()
    threads: Annotated[tuple[int, ...], arg(help="numbers of threads (default: 1 and all cores)")] = ()
    runs: Annotated[int, arg(help="runs of each operation; at least 7 for published medians")] = 15
    seed: int = 0
    peer: Annotated[
        str | None,
        arg(help="MODULE:FUNCTION of another CPU rasteriser, see benchmarks/README.md", help_behavior_hint=""),
    ] = None
    quick: Annotated[bool, arg(help="a minute: two small maps, one width, 7 runs, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "cpu"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def alone(work: Callable[..., Any], *arguments: Any) -> Any:
    """Run a function in a fresh process and return its result: cold caches, its own peak memory."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, initializer=_end_with, initargs=(os.getpid(),)) as pool:
        return pool.submit(work, *arguments).result()


def _end_with(parent: int) -> None:
    """End this process with SIGTERM when its parent ends, however that happens."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        signal.raise_signal(signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def supported_isas() -> tuple[str, ...]:
    """List the supported instruction sets, widest first."""
    from sigmasplat.native import _core

    return tuple(_core.supported_isas())


def wanted(options: Options) -> list[dict[str, Any]]:
    """List the requests of these options, small maps first."""
    quick = options.quick
    shared = {
        "path": options.source,
        "index": options.frame,
        "runs": min(options.runs, 7) if quick else options.runs,
        "isas": options.isas or supported_isas(),
        "threads": options.threads or tuple(sorted({1, usable_cores()})),
        "seed": options.seed,
        "peer": options.peer,
    }
    widths, maps = sorted(options.widths)[: 1 if quick else None], sorted(options.splats)[: 2 if quick else None]
    return [{"splats": splats, "width": width, **shared} for width in widths for splats in maps]


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every scene, then plain torch on a small one; return the figures."""
    from cpu_scene import Request, compare_reference, load_peer, measure

    if options.peer:
        load_peer(options.peer)
    requests, figures = [Request(**request) for request in wanted(options)], []
    for request in requests:
        start = time.perf_counter()
        figures.append(alone(measure, request))
        took = time.perf_counter() - start
        print(f"{request.splats:>7} splats, {request.width} pixels wide: {took:.0f} s", file=sys.stderr, flush=True)
    plain_torch = alone(compare_reference, requests[0], QUICK_REFERENCE if options.quick else REFERENCE)
    return {"source": Path(options.source).name, "scenes": figures, "reference": plain_torch}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    refused = (SigmaSplatError, ValueError, ImportError, AttributeError)
    name = Path(options.source).name
    return program.run("cpu", options, measure_all, [options.seed], not options.quick, refused, source=name)


if __name__ == "__main__":
    program.start(main, Options)
