"""Measure over many runs: sigmasplat bench. torch is loaded only when a run needs it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.bench_table import PaperTable
from sigmasplat.commands.input_options import Limit
from sigmasplat.commands.options import prepare_torch
from sigmasplat.config.presets import default_preset
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.evaluation.ablation import (
    COMPARED,
    Job,
    Results,
    Runner,
    Study,
    common_config,
    run_job,
    run_jobs,
)

if TYPE_CHECKING:
    from rich.table import Table

    from sigmasplat.run.terminal import Screen

DEFAULT_PRESET = default_preset()
WIDTH = 132
"""Width of a table in characters if the output is not a terminal."""
BEST = "best value of its column"


@dataclass(frozen=True)
class Ablation:
    """Enable the weights of σ² one by one (tracking, loops, registration, final map) and compare the results.

    Runs that FILE already contains are not repeated.

    example: sigmasplat bench ablation data/kitchen synthetic:seed={seed} --limit 300
    """

    sources: options.SourcePaths
    preset: options.PresetName = DEFAULT_PRESET
    settings: options.Settings = ()
    seeds: options.Seeds = 3
    tau: options.Tau = 10.0
    limit: Limit = None
    without_variance: options.WithoutVariance = False
    out: options.AblationFile = Path("ablation.json")
    overwrite: options.DropRuns = False
    keep: options.Keep = None

    def study(self) -> Study:
        """Return what to compare. Raises ConfigError on invalid values."""
        if not self.sources:
            raise ConfigError("no SOURCE given; give one or more folders of sequences")
        config = common_config(self.preset, self.settings, self.tau)
        sources, given = tuple(dict.fromkeys(self.sources)), tuple(split_settings(self.settings))
        return Study(sources, config, self.seeds, self.limit, self.without_variance, given)

    def run(self, runner: Runner | None = None) -> int:
        """Make the missing runs, write FILE after each run, print a table for each sequence, and return 0.

        `runner` replaces the SLAM run and its evaluation. Raises SigmaSplatError.
        """
        from sigmasplat.run.terminal import Screen

        screen, study = Screen(), self.study()
        results = Results(self.out, study, self.overwrite)
        if runner is None:
            check_sources(study, screen)
            prepare_torch()
            runner = partial(run_job, screen=screen)
        results.write()
        jobs = [job for source in study.sources for job in study.jobs(source)]
        try:
            for source in study.sources:
                run_jobs(study.jobs(source), results, runner, self.keep, partial(_announce, screen, jobs, results))
                show(screen, study, source, results.of(source))
        except BaseException:
            screen.say(
                f"{len(results.runs)} of {len(jobs)} runs are in {self.out}; repeat the command to make the others"
            )
            raise
        screen.say(f"{len(jobs)} runs: {self.out}")
        return 0


def bench(
    which: Annotated[
        Annotated[Ablation, tyro.conf.subcommand("ablation")] | Annotated[PaperTable, tyro.conf.subcommand("table")],
        tyro.conf.arg(name="", prefix_name=False),
    ],
) -> int:
    """Measure over many runs: what each use of uncertainty contributes, and the tables of papers.

    example: sigmasplat bench ablation data/kitchen --seeds 5
    """
    return which.run()


def check_sources(study: Study, screen: "Screen") -> None:
    """Open every sequence once, so that a wrong path fails now and not after hours; warn of wrong depth units.

    Raises SourceError.
    """
    from sigmasplat.input.recorded import depth_warning
    from sigmasplat.plugins.sources import open_source

    for source in study.sources:
        paths = dict.fromkeys(job.path for job in study.jobs(source))
        opened = [open_source(path, limit=study.limit or 0) for path in paths]
        warning = depth_warning(opened[0])
        if warning:
            screen.warn(f"{source}: {warning}")


def show(screen: "Screen", study: Study, source: str, runs: Sequence[dict[str, Any]]) -> None:
    """Print a sequence's table and the verdict on each weight."""
    if not screen.out.is_terminal:
        screen.out.width = WIDTH
    screen.out.print(table(study, source, runs))
    for line in verdict_lines(study.variants, runs, study.seeds):
        screen.say(line)
    screen.say("")


def table(study: Study, source: str, runs: Sequence[dict[str, Any]]) -> "Table":
    """Return mean ± standard deviation over seeds, one row per variant; * marks the best of a column."""
    from rich.table import Table

    from sigmasplat.plugins.evaluation.paired_comparison import columns, rows

    figures = columns(runs)
    caption = f"mean ± standard deviation of {study.seeds} seeds · τ {study.config.tracking.tau:g} · * {BEST}"
    made = Table("weights of σ²", title=source, caption=caption)
    for figure in figures:
        made.add_column(figure.head, justify="right")
    for row in rows(runs, study.variants, lambda text: f"* {text}", figures):
        made.add_row(*row)
    return made


def verdict_lines(variants: Sequence[str], runs: Sequence[dict[str, Any]], seeds: int) -> list[str]:
    """Return a line per pair of variants: which figures change, and how likely such a change is by chance."""
    from sigmasplat.plugins.evaluation.paired_comparison import described, paired_differences, passed_by_chance

    pairs = [(changed, against) for changed, against in COMPARED if {changed, against} <= set(variants)]
    lines = [
        f"{changed} against {against}: {described(paired_differences(runs, changed, against))}"
        for changed, against in pairs
    ]
    if seeds < 2:
        return lines
    share = f"{passed_by_chance(seeds):.0%}"
    return [
        *lines,
        f"helps, harms: the mean difference at equal seeds is larger than one standard deviation of the {seeds} "
        f"differences. A change without any effect passes this threshold in {share} of cases by chance.",
    ]


def _announce(screen: "Screen", jobs: Sequence[Job], results: Results, job: Job) -> None:
    """Print which run starts, and the remaining time, estimated from the runs so far."""
    durations_s = [run["wall_s"] for run in results.runs]
    left_min = sum(durations_s) / len(durations_s) * (len(jobs) - len(durations_s)) / 60 if durations_s else None
    rest = "" if left_min is None else f" (about {max(left_min, 1):.0f} min left)"
    screen.say(f"[{len(durations_s) + 1}/{len(jobs)}] {job.source}, {job.variant}, seed {job.seed}{rest}")
