"""Compare the processor time of commands, and of a run, with that of another checkout of this repository.

Both checkouts run the same command by turns, each time in a new process, whose user and system time is read. The order
changes with each pair. The ratio is the median of the ratios of the pairs; its range is that of the middle half.
Writes benchmarks/results/startup-<machine>.json and prints a table. Linux only; the other checkout must be built.

example: python benchmarks/startup.py --other ../before --pairs 15
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from tables import Section, significant

arg = tyro.conf.arg
QUICK = ("--no-eval", "--set", "final.iterations=0")
COMMANDS: dict[str, tuple[str, ...]] = {
    "import sigmasplat": ("-c", "import sigmasplat"),
    "--help": ("-m", "sigmasplat", "--help"),
    "run --help": ("-m", "sigmasplat", "run", "--help"),
    "run of one frame": (
        "-m", "sigmasplat", "run", "synthetic:frames=1,width=64,height=48", "--out", "OUT", "--overwrite", *QUICK,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Compare the processor time of commands, and of a run, with that of another checkout."""

    other: Annotated[Path, arg(help="the other checkout, with its kernels built")]
    pairs: Annotated[int, arg(help="pairs of each command")] = 15
    run_pairs: Annotated[int, arg(help="pairs of the run")] = 5
    source: Annotated[str, arg(help="sequence of the run: a name in the data folder, or a path")] = "redkitchen"
    limit: Annotated[int, arg(help="frames of the run")] = 100
    name: Annotated[str, arg(help="name of the results")] = "startup"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def processor_s(checkout: Path, words: tuple[str, ...]) -> float:
    """Return the user and system time of a Python process that imports from a checkout."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    path = {"PYTHONPATH": str(checkout / "src"), "SIGMASPLAT_THREADS": "1", "OMP_NUM_THREADS": "1"}
    child = subprocess.Popen(
        [sys.executable, *words], env=environment | path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(child.pid, 0)
    if child.returncode is None:
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{checkout}: {' '.join(words)} ended with exit code {child.returncode}")
    return used.ru_utime + used.ru_stime


def compared(name: str, words: tuple[str, ...], pairs: int, other: Path) -> dict[str, Any]:
    """Return the times of both checkouts, s, and their ratio."""
    checkouts = {"this": record.ROOT, "other": other}
    for checkout in checkouts.values():  # writes compiled modules, reads files into memory
        processor_s(checkout, words)
    times: dict[str, list[float]] = {"this": [], "other": []}
    for number in range(pairs):
        for which in ("this", "other") if number % 2 else ("other", "this"):
            times[which].append(processor_s(checkouts[which], words))
    ratios = np.array(times["this"]) / np.array(times["other"])
    low, median, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    return {
        "command": name, "pairs": pairs, "this_s": float(np.median(times["this"])),
        "other_s": float(np.median(times["other"])), "ratio": float(median), "ratio_range": [float(low), float(high)],
        "times_s": times,
    }  # fmt: skip


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of the results."""
    figures = measured["figures"]
    rows = [
        [
            each["command"], str(each["pairs"]), significant(each["other_s"]), significant(each["this_s"]),
            f"{each['ratio']:.3f}", "–".join(f"{value:.3f}" for value in each["ratio_range"]),
        ]
        for each in figures["commands"]
    ]  # fmt: skip
    header = ["command", "pairs", "other, s", "this, s", "ratio", "middle half"]
    return [Section(f"Processor time beside {figures['other']}", header, rows)]


def main(options: Options) -> int:
    """Measure, write the results and print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        target, source = str(Path(scratch) / "run"), str(accuracy.located(options.source))
        run = ("-m", "sigmasplat", "run", source, "--limit", str(options.limit), "--out", "OUT", "--overwrite", *QUICK)
        asked = {name: (words, options.pairs) for name, words in COMMANDS.items()}
        asked[f"run of {options.limit} frames of {options.source}"] = run, options.run_pairs
        found = [
            compared(name, tuple(target if word == "OUT" else word for word in words), pairs, options.other)
            for name, (words, pairs) in asked.items()
            if pairs
        ]
    git = ["git", "-C", str(options.other), "rev-parse", "--short", "HEAD"]
    other = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    figures = {"other": other, "commands": found}
    measured = program.keep("startup", figures, options)
    print("\n".join(section.markdown() for section in sections(measured)))
    return 0


if __name__ == "__main__":
    program.start(main, Options, __doc__)
