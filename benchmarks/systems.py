"""Compare the systems: sequences × presets × seeds, each run alone on all threads (issue 5).

`accuracy.py` makes the runs and reuses finished ones. If the true surface is known, `sigmasplat eval --mesh` then
scores the surface of the run. Writes benchmarks/results/systems-<machine>.json and prints a table for each sequence.

example: python benchmarks/systems.py --sources synthetic --presets varsplat-fast sigma --seeds 0 1
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import program
import tyro
from accuracy_tables import Result, failures, groups, spread, values_of
from tables import Section

from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
SOURCES = ("synthetic", "livingroom", "redkitchen")
PRESETS = ("varsplat-fast", "loopsplat-fast", "cgslam-fast", "cgslam-loops-fast", "sigma")
COSTS = ("finish_s", "worst_frame_s", "map_bytes")
SURFACE = (
    "accuracy_m", "completion_m", "completion_ratio",
    "splats_accuracy_m", "splats_completion_m", "splats_chamfer_m", "floaters",
)  # fmt: skip
"""Figures of `reconstruction` in metrics.json, in addition to those of `accuracy.figures_of`."""


@dataclass(frozen=True)
class Options(accuracy.Options):
    """Compare the systems: sequences × presets × seeds, each run alone on all threads."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = SOURCES
    presets: Annotated[tuple[str, ...], arg(help="presets of the systems to compare")] = PRESETS
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "systems"


def refuse_unequal_input(presets: Sequence[str], settings: Sequence[str]) -> None:
    """Raise ConfigError unless all presets, with these settings, have equal `input` settings."""
    changes = split_settings(settings)
    taken = {name: override(preset_of(name), changes).to_dict()["input"] for name in presets}
    first = presets[0]
    for name, values in taken.items():
        for key, value in values.items():
            if value != taken[first][key]:
                unequal = f"input.{key} is {taken[first][key]} in {first} and {value} in {name}"
                raise ConfigError(f"{unequal}; set one value for all: --set input.{key}={value}")


def figures_of(metrics: dict[str, Any]) -> dict[str, float | None]:
    """Return a run's figures from its metrics.json; None for a missing one."""
    surface = metrics.get("reconstruction") or {}
    picked = {name: metrics.get(name) for name in COSTS} | {name: surface.get(name) for name in SURFACE}
    return accuracy.figures_of(metrics) | picked


def with_surface(job: accuracy.Job, result: dict[str, Any], runs: Path, before: Sequence[str] = ()) -> dict[str, Any]:
    """Return a job's result with all figures of its run; score the surface first if it is known and not scored yet.

    If the surface cannot be scored, `problem` says why. `before` is put before the command, to choose cores.
    """
    if result["problem"]:
        return result
    run = job.folder(runs) / "run"
    try:
        metrics = RunFolder.open(run).read_metrics()
        if metrics["reconstruction"] is None and open_source(job.path).true_surface() is not None:
            command = [*before, sys.executable, "-m", "sigmasplat.cli", "eval", str(run)]
            command += ["--mesh", "--random-views", "0"]
            problem, _ = accuracy.call(command, run.parent / "surface.txt")
            if problem:
                return result | {"problem": f"eval --mesh: {problem}"}
            metrics = RunFolder.open(run).read_metrics()
    except SigmaSplatError as problem:
        return result | {"problem": str(problem)}
    return result | {"figures": figures_of(metrics)}


# ---- tables ----


ROWS = (
    ("ATE, cm", "ate_m", 100.0),
    ("lost frames", "lost", 1.0),
    ("PSNR held-out, dB", "held_out_psnr_db", 1.0),
    ("depth L1 held-out, cm", "held_out_depth_l1_m", 100.0),
    ("Spearman V ~ error²", "spearman", 1.0),
    ("Accuracy, cm", "accuracy_m", 100.0),
    ("Completion, cm", "completion_m", 100.0),
    ("Completion ratio, %", "completion_ratio", 100.0),
    ("Chamfer of splats, cm", "splats_chamfer_m", 100.0),
    ("map, MB", "map_bytes", 1e-6),
    ("splats, k", "splats", 1e-3),
    ("frames/s", "frames_per_s", 1.0),
    ("finish, s", "finish_s", 1.0),
    ("worst frame, ms", "worst_frame_s", 1e3),
    ("peak memory, MiB", "peak_mib", 1.0),
)
"""Title, name of the figure, factor to the unit of the title; a row without any value is left out."""
NOTE = (
    "Mean ± standard deviation over the seeds. Frames/s includes reading, tracking, mapping and loops; `finish` is the "
    "time of the final map after the last frame. Worst frame: without the first frame, and without reading."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by systems.py: one per sequence, and what failed."""
    results = measured["figures"]["jobs"]
    sources = dict.fromkeys(result["job"]["source"] for result in results)
    made = [sequence(source, [r for r in results if r["job"]["source"] == source]) for source in sources]
    return [section for section in [*made, failures(results)] if section.rows]


def sequence(source: str, results: list[Result]) -> Section:
    """Tabulate the runs of one sequence."""
    by_preset = {preset: runs for (_, preset), runs in groups(results).items()}
    rows = [["runs", *(str(len(runs)) for runs in by_preset.values())]]
    for title, figure, factor in ROWS:
        values = [[factor * value for value in values_of(runs, figure)] for runs in by_preset.values()]
        rows += [[title, *map(spread, values)]] if any(values) else []
    return Section(source, ["figure", *by_preset], rows, NOTE)


def main(options: Options) -> int:
    """Run, score, write the results, print them; exit code 1 if a job failed, 2 if the options are invalid."""
    try:
        refuse_unequal_input(options.presets, options.settings)
        jobs = accuracy.jobs_of(options)
    except SigmaSplatError as problem:
        return program.refuse("systems", problem)
    results = accuracy.run_all(jobs, options)
    scored = [with_surface(job, result, options.runs) for job, result in zip(jobs, results, strict=True)]
    return accuracy.publish("systems", scored, options)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
