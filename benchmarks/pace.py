"""Compare the pace of whole runs with that of another checkout: frames/s, longest frame, time of the final map.

Both checkouts run the same recording by turns, each time in a new process with all cores; the order changes with each
pair. Runs are not scored: map_quality.py compares their maps and paths. The ratio of a pair is this checkout's value by
the other's. Writes benchmarks/results/pace-<machine>.json and prints tables.

example: python benchmarks/pace.py --before ../before/.venv/bin/sigmasplat --sequences redkitchen --pairs 2
"""

import json
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from tables import Section, significant

from sigmasplat.commands.options import Settings

arg = tyro.conf.arg
CODES = ("now", "before")
FIGURES = {
    "frames_per_s": "frames/s", "median_ms": "median frame, ms", "p99_ms": "p99, ms", "longest_ms": "longest frame, ms",
    "final_s": "final map, s", "total_s": "frames and final map, s",
}  # fmt: skip
"""Figures of a run: heading. The first frame is left out of the longest one: it loads libraries."""


@dataclass(frozen=True)
class Options:
    """Compare the pace of whole runs with that of another checkout."""

    before: Annotated[str, arg(help="sigmasplat of the other checkout")]
    sequences: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = ("redkitchen", "livingroom")
    pairs: Annotated[int, arg(help="pairs of runs of each sequence")] = 3
    limit: Annotated[int, arg(help="use at most this many frames; 0 = all")] = 0
    settings: Settings = ()
    quick: Annotated[bool, arg(help="print the tables, write no results", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "pace"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def command_of(code: str, options: Options) -> list[str]:
    """Return the command of a checkout: this one, or the one before."""
    return [sys.executable, "-m", "sigmasplat.cli"] if code == "now" else shlex.split(options.before)


def measured_run(code: str, sequence: str, options: Options, folder: Path) -> dict[str, float]:
    """Run a sequence; return the figures. Raises ValueError if the run fails."""
    words = [*command_of(code, options), "run", accuracy.located(sequence), "--out", str(folder), "--overwrite"]
    words += ["--no-eval", *(["--limit", str(options.limit)] if options.limit else [])]
    words += [word for setting in options.settings for word in ("--set", setting)]
    print(shlex.join(words), file=sys.stderr, flush=True)
    environment = program.environment_of(other=code != "now")
    ended = subprocess.run(words, capture_output=True, text=True, env=environment)
    if ended.returncode:
        raise ValueError(f"{code}: {sequence}: {(ended.stderr.strip().splitlines() or ['no message'])[-1]}")
    lines = (folder / "log.jsonl").read_text().splitlines()
    return figures_of(
        [json.loads(line)["seconds"]["total"] for line in lines], json.loads((folder / "run.json").read_text())
    )


def figures_of(frames_s: list[float], facts: dict[str, Any]) -> dict[str, float]:
    """Return the figures of a run from the seconds of its frames and its run.json."""
    later_ms, final_s = 1e3 * np.array(frames_s[1:]), float(facts.get("finish_s") or 0.0)
    return {
        "frames_per_s": len(frames_s) / facts["wall_s"], "median_ms": float(np.median(later_ms)),
        "p99_ms": float(np.percentile(later_ms, 99)), "longest_ms": float(later_ms.max()), "final_s": final_s,
        "total_s": facts["wall_s"] + final_s,
    }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Measure every sequence by turns. Raises ValueError if a run fails."""
    found = []
    with TemporaryDirectory(prefix="pace-") as scratch:
        for sequence in options.sequences:
            runs: dict[str, list[dict[str, float]]] = {code: [] for code in CODES}
            for pair in range(options.pairs):
                for code in CODES if pair % 2 else reversed(CODES):
                    runs[code].append(measured_run(code, sequence, options, Path(scratch) / "run"))
            found.append({"sequence": Path(sequence).name, "runs": runs})
    return {"sequences": found}


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table for each sequence: medians of both checkouts, and the ratio of each pair."""
    written = []
    for each in measured["figures"]["sequences"]:
        rows = []
        for name, heading in FIGURES.items():
            now, before = (np.array([run[name] for run in each["runs"][code]]) for code in CODES)
            ratios = now / np.where(before == 0.0, np.nan, before)
            row = [heading, significant(float(np.median(now))), significant(float(np.median(before)))]
            rows.append([*row, significant(float(np.median(ratios))), ", ".join(f"{ratio:.2f}" for ratio in ratios)])
        head = ("", "now", "before", "ratio", "ratio of each pair")
        written.append(Section(f"{each['sequence']}: pace", head, rows, "Medians; runs by turns."))
    return written


def main(options: Options) -> int:
    """Measure, write the results and print the tables."""
    return program.run("pace", options, measure, write=not options.quick, refused=(ValueError,))


if __name__ == "__main__":
    program.start(main, Options, __doc__)
