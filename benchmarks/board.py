"""Say in a few minutes what a change did to path, map, failures and time: twelve recordings, one seed.

Two processes of one thread run every row with the command line of the checkout, without the final map. Results are kept
in --cache by commit and by the bytes of src, so that only new code is run. With BEFORE, a revision, that commit's own
code runs in a worktree and stands beside; differences beyond the noise (board_tables.py) are marked better or worse.
Both are scored by today's code. plain.py runs once for each of its versions and is a column beside them; a row where
SigmaSplat is worse than it is marked. Writes benchmarks/results/<name>-<machine>.json and prints a table. Linux only.

example: python benchmarks/board.py HEAD~1
"""

import os
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import board_runs
import program
import record
import tyro
from board_code import Code, Kept, current, plain_system, revision
from board_runs import Row
from disturbances import plan
from disturbed_recordings import with_truth

from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.sources import open_source

arg = tyro.conf.arg
ROWS = (
    Row("fr1_xyz", "fr1_xyz"),
    Row("livingroom", "livingroom"),
    Row("redkitchen", "redkitchen", limit=350),
    Row("hololens", "hololens", limit=220),
    Row("cubicles", "cubicles"),
    Row("cabinet58", "cabinet58"),
    Row("room, noisy", f"{accuracy.SYNTHETIC},noise=1"),
    Row("corridor", "synthetic:corridor", limit=150),
    Row("redkitchen, kidnapped", "redkitchen", "kidnapped", 2, frames=40, limit=130, start_s=16.0),
    Row("livingroom, 8 × faster", "livingroom", "speed", 3, frames=36, limit=300),
    Row("fr1_xyz, depth late", "fr1_xyz", "desync", 2, frames=80, limit=90),
    Row("fr1_xyz, big object", "fr1_xyz", "moving-object", 2, frames=80, limit=110),
)
PROCESSES = 2


@dataclass(frozen=True)
class Options:
    """Say in a few minutes what a change did to path, map, failures and time."""

    before: Annotated[
        tyro.conf.Positional[str], arg(help="revision to compare with", help_behavior_hint="(default: none)")
    ] = ""
    rows: Annotated[tuple[str, ...], arg(help="names of rows")] = tuple(row.name for row in ROWS)
    seeds: Annotated[tuple[int, ...], arg(help="seeds of the runs; several measure the noise")] = (0,)
    quick: Annotated[bool, arg(help="print the table, write no results", help_behavior_hint="")] = False
    fresh: Annotated[bool, arg(help="repeat runs that exist already", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "board"
    cache: Annotated[Path, arg(help="folder of the results of each commit")] = record.ROOT / "build" / "board"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class Task:
    """One run that is to be made: whose code, of what, with which seed."""

    code: Code
    row: Row
    seed: int


def possible(names: tuple[str, ...]) -> tuple[list[Row], list[str]]:
    """Return the rows whose recording exists, has a truth and is long enough, and one line for each other one.

    No image is decoded. Raises ConfigError for an unknown name.
    """
    kept, left_out = list[Row](), list[str]()
    for row in board_runs.named(names, ROWS):
        path = accuracy.located(row.source)
        try:
            if row.disturbance:
                available = with_truth(path, row.start_s, row.limit)[2]
                plan(row.disturbance, row.severity, board_runs.EVENT_SEED, row.frames, available)
            elif open_source(path).truth() is None:
                raise ValueError("its true path is unknown")
            kept.append(row)
        except (SigmaSplatError, ValueError) as problem:
            left_out.append(f"{row.name}: {problem}")
    return kept, left_out


def measure(options: Options) -> dict[str, Any]:
    """Run or read every row of each code. Raises SigmaSplatError if a code or a row cannot be prepared."""
    start = time.perf_counter()
    rows, left_out = possible(options.rows)
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr, flush=True)
    codes = [current(), *([revision(options.before)] if options.before else [])]
    peer = plain_system()
    kept = {code: Kept.of(code, options.cache) for code in (*codes, peer)}
    tasks = [
        Task(code, row, seed)
        for row in sorted(rows, key=lambda row: board_runs.COST_S.get(row.name, 0.0), reverse=True)
        for code in (*codes, peer)
        for seed in (options.seeds if code is not peer else (0,))
        if options.fresh or kept[code].found(row, seed) is None
    ]
    run_all(tasks, kept)
    found = [
        {"code": code.name, "name": row.name, "seed": seed, **kept[code].results[row.key(seed)]}
        for code in codes
        for row in rows
        for seed in options.seeds
    ]
    return {
        "rows": found,
        "plain": {row.name: kept[peer].results[row.key(0)] for row in rows},
        "left_out": left_out,
        "codes": [{"name": code.name, "commit": code.commit, "digest": code.digest} for code in (*codes, peer)],
        "runs_made": len(tasks),
        "duration_s": round(time.perf_counter() - start, 1),
        "load_average_after": os.getloadavg()[0],
    }


def run_all(tasks: list[Task], kept: dict[Code, Kept]) -> None:
    """Perform tasks, two at a time, each run in its own process; keep each result when it is there."""
    if not tasks:
        return
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="board-")))
        checkouts = {code: code.ready(stack, scratch) for code in dict.fromkeys(task.code for task in tasks)}
        pool = stack.enter_context(ThreadPoolExecutor(PROCESSES, initializer=board_runs.one_thread))
        running = {
            pool.submit(board_runs.perform, task.row, task.seed, checkouts[task.code], scratch): task for task in tasks
        }
        for number, done in enumerate(as_completed(running), 1):
            task, result = running[done], done.result()
            kept[task.code].keep(task.row, task.seed, result)
            how = result["problem"] or f"{result['wall_s']:.0f} s"
            print(f"[{number}/{len(tasks)}] {task.code.name}: {task.row.name}: {how}", file=sys.stderr, flush=True)


def main(options: Options) -> int:
    """Measure, write the results, print the table; return the exit code."""
    return program.run("board", options, measure, options.seeds, write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
