"""Start a benchmark: parse its options, measure, write the results, print their tables."""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import record
import tables
import tyro

from sigmasplat.errors import ConfigError, SigmaSplatError

Options = TypeVar("Options")
NOT_RECORDED = ("runs", "out", "fresh", "quick", "scratch", "other", "collect", "keep")
"""Options that do not affect the measurements."""


def start(main: Callable[[Options], int], options: type[Options], description: str | None = None) -> NoReturn:
    """Parse the command line, check that results can be written, run `main`, exit with its code."""
    parsed = tyro.cli(options, description=description, config=(tyro.conf.FlagCreatePairsOff,))
    if hasattr(parsed, "out") and not getattr(parsed, "quick", False):
        try:
            record.refuse_unwritable(parsed.out)
        except ConfigError as problem:
            sys.exit(refuse(Path(sys.argv[0]).stem, problem))
    sys.exit(main(parsed))


def environment_of(other: bool) -> dict[str, str]:
    """Return the environment of a command of this checkout, or of another one, which must not find modules of this
    one."""
    return {name: value for name, value in os.environ.items() if not (other and name == "PYTHONPATH")}


def refuse(benchmark: str, problem: Exception) -> int:
    """Print in one line why a benchmark cannot run; return its exit code."""
    print(f"{benchmark}.py: {problem}", file=sys.stderr)
    return 2


def keep(
    benchmark: str, figures: dict[str, Any], options: Any, seeds: Sequence[int] = (), write: bool = True, **config: Any
) -> dict[str, Any]:
    """Return results with the options they were measured with; write them too, unless an option disables it.

    `options` have a `name` and the folder `out`; `config` replaces values of them in the results.
    """
    recorded = {name: value for name, value in asdict(options).items() if name not in NOT_RECORDED} | config
    measured = record.results(benchmark, figures, name=options.name, seeds=seeds, config=recorded)
    print(record.write(measured, options.out) if write else "nothing is written", file=sys.stderr)
    return measured


def run(
    benchmark: str,
    options: Options,
    measure: Callable[[Options], dict[str, Any]],
    seeds: Sequence[int] = (),
    write: bool = True,
    refused: tuple[type[Exception], ...] = (SigmaSplatError,),
    **config: Any,
) -> int:
    """Measure, keep the results, print their tables.

    Return the exit code: 1 if a single run failed, 2 if `measure` raised one of `refused`.
    """
    try:
        figures = measure(options)
    except refused as problem:
        return refuse(benchmark, problem)
    print(tables.table(keep(benchmark, figures, options, seeds, write, **config)))
    items = [item for value in figures.values() if isinstance(value, list) for item in value]
    return int(any(item.get("problem") for item in items if isinstance(item, dict)))  # others say what was left out
