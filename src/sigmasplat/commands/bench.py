"""Offer measurements that take many runs: sigmasplat bench ablation; torch loads where it is needed."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.options import prepare_torch
from sigmasplat.errors import ConfigError
from sigmasplat.evaluation.ablation import COMPARED, Job, Results, Runner, Study, carry_out, common_config, perform
from sigmasplat.presets import default_preset

if TYPE_CHECKING:
    from rich.table import Table

    from sigmasplat.run.terminal import Screen

DEFAULT_PRESET = default_preset()
WIDTH = 132
"""Columns of a table where there is no terminal to fit it to."""
BEST = "best of its column"


@dataclass(frozen=True)
class Ablation:
    """Switch on the weights of σ² one by one (tracking, loops, registration, final map); say which helps.

    Runs that FILE already holds are not made again.

    example: sigmasplat bench ablation data/kitchen synthetic:seed={seed} --limit 300
    """

    sources: options.SourcePaths
    preset: options.PresetName = DEFAULT_PRESET
    settings: options.Settings = ()
    seeds: options.Seeds = 3
    tau: options.Tau = 10.0
    limit: options.Limit = None
    without_variance: options.WithoutVariance = False
    out: options.AblationFile = Path("ablation.json")
    overwrite: options.DropRuns = False
    keep: options.Keep = None

    def study(self) -> Study:
        """Return what is to be compared. Raises ConfigError on settings that mean nothing."""
        if not self.sources:
            raise ConfigError("no SOURCE given; give one or more folders of sequences")
        for name, value in (("seeds", self.seeds), ("limit", self.limit)):
            if value is not None and value < 1:
                raise ConfigError(f"--{name} must be at least 1, found {value}")
        config = common_config(self.preset, self.settings, self.tau)
        return Study(tuple(dict.fromkeys(self.sources)), config, self.seeds, self.limit, self.without_variance)

    def run(self, runner: Runner | None = None) -> int:
        """Run what has not been run, print a table a sequence, write FILE after every run; return 0.

        `runner` takes the place of a whole run of SLAM and its evaluation. Raises SigmaSplatError.
        """
        from sigmasplat.run.terminal import Screen

        screen, study = Screen(), self.study()
        results = Results(self.out, study, self.overwrite)
        if runner is None:
            check_sources(study, screen)
            prepare_torch()
            runner = partial(perform, screen=screen)
        results.write()
        jobs = [job for source in study.sources for job in study.jobs(source)]
        try:
            for source in study.sources:
                carry_out(study.jobs(source), results, runner, self.keep, partial(_tell, screen, jobs, results))
                show(screen, study, source, results.of(source))
        except BaseException:
            screen.say(f"{len(results.runs)} of {len(jobs)} runs are in {self.out}; the same command goes on there")
            raise
        screen.say(f"{len(jobs)} runs: {self.out}")
        return 0


def bench(
    which: Annotated[
        Annotated[Ablation, tyro.conf.subcommand("ablation")] | Annotated[None, tyro.conf.Suppress],
        tyro.conf.arg(name="", prefix_name=False),
    ],
) -> int:
    """Measure over many runs: what each use of uncertainty is worth.

    example: sigmasplat bench ablation data/kitchen --seeds 5
    """
    assert which is not None, "tyro asks for a subcommand"
    return which.run()


def check_sources(study: Study, screen: "Screen") -> None:
    """Open every sequence once, so that a wrong path is said now and not hours later; warn of wrong depth units.

    Raises SourceError.
    """
    from sigmasplat.sources import open_source
    from sigmasplat.sources.camera.depth_units import depth_warning

    for source in study.sources:
        paths = dict.fromkeys(job.path for job in study.jobs(source))
        opened = [open_source(path, limit=study.limit or 0) for path in paths]
        warning = depth_warning(opened[0])
        if warning:
            screen.warn(f"{source}: {warning}")


def show(screen: "Screen", study: Study, source: str, runs: Sequence[dict[str, Any]]) -> None:
    """Print a sequence's table and, in words, which weight helps."""
    if not screen.out.is_terminal:
        screen.out.width = WIDTH
    screen.out.print(table(study, source, runs))
    for line in said(study.variants, runs, study.seeds):
        screen.say(line)
    screen.say("")


def table(study: Study, source: str, runs: Sequence[dict[str, Any]]) -> "Table":
    """Lay out mean ± standard deviation over seeds, a row a variant, the best of a column starred."""
    from rich.table import Table

    from sigmasplat.evaluation.paired_comparison import columns, rows

    figures = columns(runs)
    caption = f"mean ± standard deviation of {study.seeds} seeds · τ {study.config.tracking.tau:g} · * {BEST}"
    made = Table("weights of σ²", title=source, caption=caption)
    for figure in figures:
        made.add_column(figure.head, justify="right")
    for row in rows(runs, study.variants, lambda text: f"* {text}", figures):
        made.add_row(*row)
    return made


def said(variants: Sequence[str], runs: Sequence[dict[str, Any]], seeds: int) -> list[str]:
    """Say of each variant what it does against the one before, and how much that means."""
    from sigmasplat.evaluation.paired_comparison import effects, passed_by_chance, sentence

    pairs = [(changed, against) for changed, against in COMPARED if {changed, against} <= set(variants)]
    lines = [f"{changed} against {against}: {sentence(effects(runs, changed, against))}" for changed, against in pairs]
    if seeds < 2:
        return lines
    share = f"{passed_by_chance(seeds):.0%}"
    return [
        *lines,
        f"Helps and harms: the mean difference at equal seeds is beyond one standard deviation of the {seeds} "
        f"differences. {share} of figures that nothing changed but chance pass that bar.",
    ]


def _tell(screen: "Screen", jobs: Sequence[Job], results: Results, job: Job) -> None:
    """Print which run begins, and how long the rest may take by the runs so far."""
    taken = [run["wall_s"] for run in results.runs]
    left_min = sum(taken) / len(taken) * (len(jobs) - len(taken)) / 60 if taken else None
    rest = "" if left_min is None else f" (about {max(left_min, 1):.0f} min left)"
    screen.say(f"[{len(taken) + 1}/{len(jobs)}] {job.source}, {job.variant}, seed {job.seed}{rest}")
