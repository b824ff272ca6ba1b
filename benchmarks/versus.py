"""Compare the speed of the CPU kernels of this checkout with those of another one, measured in turns.

The speed of a machine can halve from one hour to the next; in turns, both checkouts run under the same conditions. Both
need built kernels (make native). Writes benchmarks/results/versus-<machine>.json and prints its table.

example: git worktree add ../before v0.1 && make -C ../before native && python benchmarks/versus.py ../before
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import tyro
from cpu import default_source
from tables import Section, significant
from versus_works import NAMES

from sigmasplat.files.machine import usable_cores

arg = tyro.conf.arg
CHILD = Path(__file__).with_name("versus_works.py")


@dataclass(frozen=True)
class Options:
    """Compare the speed of the CPU kernels of this checkout with those of another one."""

    other: Annotated[tyro.conf.Positional[Path], arg(help="the other checkout, with built kernels")]
    source: Annotated[str, arg(help="sequence whose depth becomes splats")] = field(default_factory=default_source)
    frame: Annotated[int, arg(help="frame of the sequence")] = 150
    splats: Annotated[int, arg(help="size of the map")] = 77_000
    width: Annotated[int, arg(help="width of the image, pixels")] = 320
    threads: Annotated[tuple[int, ...], arg(help="numbers of threads (default: 1 and all cores)")] = ()
    rounds: Annotated[int, arg(help="number of turns of each checkout")] = 5
    runs: Annotated[int, arg(help="runs of each operation in a turn; the shortest counts")] = 30
    name: Annotated[str, arg(help="name of the results")] = "versus"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def turn(checkout: Path, request: dict[str, Any]) -> dict[str, float]:
    """Measure a checkout in a fresh process; return the shortest time of each operation, ms. Raises ValueError."""
    threads = {name: str(request["threads"]) for name in ("OMP_NUM_THREADS", "SIGMASPLAT_THREADS")}
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", str(CHILD), str(checkout), json.dumps(request)],
        capture_output=True,
        text=True,
        env={**os.environ, **threads, "SIGMASPLAT_DATA": str(record.data_root())},
    )
    if ended.returncode:
        last = ended.stderr.strip().splitlines()[-1:] or ["no message"]
        raise ValueError(f"{checkout} cannot be measured: {last[0]}; are its kernels built (make native)?")
    found: dict[str, float] = json.loads(ended.stdout.splitlines()[-1])
    return found


def measure_all(options: Options) -> dict[str, Any]:
    """Measure both checkouts in turns; return the times of each turn by checkout and number of threads."""
    o, places = options, {"this": record.ROOT, "other": options.other}
    request = {"path": o.source, "index": o.frame, "splats": o.splats, "width": o.width, "runs": o.runs}
    turns = []
    for threads in o.threads or tuple(sorted({1, usable_cores()})):
        for number in range(o.rounds):
            order = list(places.items())[:: 1 if number % 2 else -1]  # alternate which is first
            found = {name: turn(place, {**request, "threads": threads}) for name, place in order}
            turns.append({"threads": threads, **found})
            print(f"{threads} threads, turn {number + 1} of {o.rounds}", file=sys.stderr, flush=True)
    return {"other": described(o.other), "turns": turns}


def described(checkout: Path) -> str | None:
    """Return a checkout's commit, None outside git."""
    ended = subprocess.run(["git", "-C", str(checkout), "rev-parse", "HEAD"], capture_output=True, text=True)
    return ended.stdout.strip() or None


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the table of results written by versus.py."""
    figures, config = measured["figures"], measured["config"]
    header = ["threads", "operation", "before, ms", "now, ms", "now / before", "ratio by turn, median (min – max)"]
    turns: list[dict[str, Any]] = figures["turns"]
    rows = [
        _row(threads, name, [t for t in turns if t["threads"] == threads])
        for threads in sorted({t["threads"] for t in turns})
        for name in NAMES
        if name in turns[0]["this"]  # older results have fewer operations
    ]
    note = (
        f"Before: commit {str(figures['other'])[:9]}. Shortest of {config['runs']} runs in each of {len(turns)} turns; "
        f"{config['splats']} splats of {config['source']}, {config['width']} pixels wide."
    )
    return [Section("Beside another checkout", header, rows, note)]


def _row(threads: int, name: str, turns: list[dict[str, Any]]) -> list[str]:
    now, before = (np.array([turn[of][name] for turn in turns]) for of in ("this", "other"))
    ratios = now / before
    spread = " – ".join(significant(float(x), 3) for x in (ratios.min(), ratios.max()))
    return [
        str(threads),
        name,
        *(significant(float(x)) for x in (before.min(), now.min(), now.min() / before.min())),
        f"{significant(float(np.median(ratios)), 3)} ({spread})",
    ]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    config = {"source": Path(options.source).name, "runs": options.runs}
    return program.run("versus", options, measure_all, [0], refused=(ValueError,), **config)


if __name__ == "__main__":
    program.start(main, Options)
