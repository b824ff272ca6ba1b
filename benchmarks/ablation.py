"""Enable the weights of σ² one by one (tracking, loops, registration, final map), on four sequences, and compare.

Finished runs are kept in runs/bench/ablation/NAME.json and are not repeated while code and settings are unchanged.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes its tables into the documents.

example: python benchmarks/ablation.py --sources redkitchen --seeds 1 --limit 200
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import tyro
from ablation_runs import (
    COMPARED,
    NAMES,
    WITHOUT_VARIANCE,
    Job,
    Results,
    Runner,
    Study,
    common_config,
    run_job,
    run_jobs,
)  # fmt: skip
from paired_comparison import (
    CHANCE,
    FIGURES,
    PairedDifference,
    columns,
    described,
    over_sequences,
    paired_differences,
    rows,
)
from tables import Section

from sigmasplat.commands import options
from sigmasplat.commands.input_options import Limit
from sigmasplat.commands.options import prepare_torch
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.input.recorded import depth_warning
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.terminal import Screen

arg = tyro.conf.arg
DEFAULT_PRESET = default_preset()
SYNTHETIC = "synthetic:frames=240,overrun=20,noise=1,drift=6,seed={seed}"
"""A different room for each seed, a sensor that drifts, and a path that ends where it began."""
SOURCES = ("synthetic", "livingroom", "redkitchen", "hololens")
RUNS = record.ROOT / "runs" / "bench" / "ablation"


@dataclass(frozen=True)
class Options:
    """Compare the weights of σ² on four sequences."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = SOURCES
    preset: options.PresetName = DEFAULT_PRESET
    settings: options.Settings = ()
    seeds: options.Runs = 3
    tau: Annotated[float, arg(help="τ, the same for every weight and sequence")] = 10.0
    limit: Limit = None
    keep: Annotated[Path | None, arg(help="keep the run folders there", help_behavior_hint="(default: removed)")] = None
    reference: Annotated[bool, arg(help="leave out the runs without variance", help_behavior_hint="")] = True
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "ablation"
    runs: Annotated[Path, arg(help="folder of finished runs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def working_file(self) -> Path:
        """Return the file that finished runs are added to."""
        return self.runs / f"{record.slug(self.name)}.json"

    def study(self) -> Study:
        """Return what to compare. Raises ConfigError on invalid values."""
        if not self.sources:
            raise ConfigError("no source given; give --sources")
        config = common_config(self.preset, self.settings, self.tau)
        sources = tuple(dict.fromkeys(map(located, self.sources)))
        given = tuple(split_settings(self.settings))
        return Study(sources, config, self.seeds, self.limit, self.reference, given)

    def run(self, screen: Screen, runner: Runner | None = None) -> None:
        """Make the missing runs; print the verdicts on each sequence. Runs of other settings or code are dropped.

        `runner` replaces the SLAM run and its evaluation. Raises SigmaSplatError.
        """
        study, file = self.study(), self.working_file()
        if runner is None:
            check_sources(study, screen)
            prepare_torch()
            runner = partial(run_job, screen=screen)
        file.parent.mkdir(parents=True, exist_ok=True)
        results = Results(file, study)
        results.write()
        jobs = [job for source in study.sources for job in study.jobs(source)]
        try:
            for source in study.sources:
                run_jobs(study.jobs(source), results, runner, self.keep, partial(_announce, screen, jobs, results))
                for line in verdict_lines(study.variants, results.of(source), study.seeds):
                    screen.say(f"{short(source)}: {line}")
        except BaseException:
            screen.say(f"{len(results.runs)} of {len(jobs)} runs are in {file}; repeat the command to make the others")
            raise


def check_sources(study: Study, screen: Screen) -> None:
    """Open every sequence once, so that a wrong path fails now and not after hours; warn of wrong depth units.

    Raises SourceError.
    """
    for source in study.sources:
        paths = dict.fromkeys(job.path for job in study.jobs(source))
        opened = [open_source(path, limit=study.limit or 0) for path in paths]
        warning = depth_warning(opened[0])
        if warning:
            screen.warn(f"{source}: {warning}")


def verdict_lines(variants: Sequence[str], runs: Sequence[dict[str, Any]], seeds: int) -> list[str]:
    """Return a line per pair of variants: which figures change, and how often chance alone gives such a line."""
    pairs = [(changed, against) for changed, against in COMPARED if {changed, against} <= set(variants)]
    lines = [
        f"{changed} against {against}: {described(paired_differences(runs, changed, against))}"
        for changed, against in pairs
    ]
    if seeds < 2:
        return lines
    return [*lines, f"helps, harms: {RULE}; {CHANCE:.0%} of figures do so by chance."]


RULE = "the 95 % t interval of the mean difference at equal seeds excludes 0"


def _announce(screen: Screen, jobs: Sequence[Job], results: Results, job: Job) -> None:
    """Print which run starts, and the remaining time, estimated from the runs so far."""
    durations_s = [run["wall_s"] for run in results.runs]
    left_min = sum(durations_s) / len(durations_s) * (len(jobs) - len(durations_s)) / 60 if durations_s else None
    rest = "" if left_min is None else f" (about {max(left_min, 1):.0f} min left)"
    screen.say(f"[{len(durations_s) + 1}/{len(jobs)}] {job.source}, {job.variant}, seed {job.seed}{rest}")


def located(name: str) -> str:
    """Return the path of a sequence in the data folder, or the name unchanged if it is not there."""
    known = record.data_root() / name
    return SYNTHETIC if name == "synthetic" else str(known.resolve()) if known.is_dir() else name


def short(source: str) -> str:
    """Return a sequence's name for tables: the folder name, or the built-in sequence without its options."""
    return Path(source.partition(":")[0]).name


def kept(results: dict[str, Any]) -> dict[str, Any]:
    """Return an ablation's runs for the committed results: figures only, with names instead of paths."""
    named = [run | {"source": short(run["source"]), "path": Path(run["path"]).name} for run in results["runs"]]
    runs = [{name: value for name, value in run.items() if name != "metrics"} for run in named]
    return {"config": results["config"], "runs": runs}


# ---- tables ----


Runs = list[dict[str, Any]]
JUDGED = tuple(figure for figure in FIGURES if figure.judged)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results: one per sequence, `Effects`, and `Verdicts` in words."""
    runs = measured["figures"]["runs"]
    sources = list(dict.fromkeys(run["source"] for run in runs))
    by_source = {source: [run for run in runs if run["source"] == source] for source in sources}
    seeds, tau = len(measured["seeds"]), measured["config"]["tau"]
    made = [sequence(source, found, tau) for source, found in by_source.items()]
    return [*made, effects_of(by_source, seeds), *([verdicts(by_source)] if seeds > 1 and len(sources) > 1 else [])]


def variants(runs: Runs) -> list[str]:
    """List the variants that were run, in the order of the table."""
    return [name for name in (WITHOUT_VARIANCE, *NAMES) if any(run["variant"] == name for run in runs)]


def sequence(source: str, runs: Runs, tau: float) -> Section:
    """Tabulate a sequence: one row per variant, the best value of each column in bold."""
    figures, seeds = columns(runs), len({run["seed"] for run in runs})
    laid_out = rows(runs, variants(runs), lambda text: f"**{text}**", figures)
    note = f"Mean ± standard deviation of {seeds} seeds, τ = {tau:g} in every weight. Views are held out."
    worlds = len({run["path"] for run in runs})
    note += f" {worlds} worlds, one per seed." if worlds > 1 else ""
    return Section(source, ["weights of σ²", *(figure.head for figure in figures)], laid_out, note)


def effects_of(by_source: dict[str, Runs], seeds: int) -> Section:
    """Tabulate differences at equal seeds; those that show an effect are bold."""
    laid_out = []
    for source, runs in by_source.items():
        for changed, against in compared(runs):
            found = {effect.figure.name: effect for effect in paired_differences(runs, changed, against)}
            cells = [found[figure.name].written() if figure.name in found else "–" for figure in JUDGED]
            bold = [figure.name in found and found[figure.name].stands_out for figure in JUDGED]
            shown = [f"**{cell}**" if stands_out else cell for cell, stands_out in zip(cells, bold, strict=True)]
            laid_out.append([source, f"{changed} against {against}", *shown])
    note = "Mean ± standard deviation of the differences at equal seeds"
    if seeds > 1:
        note += f"; bold: {RULE} ({CHANCE:.0%} of figures do so by chance)"
    return Section("Effects", ["sequence", "change", *(figure.title for figure in JUDGED)], laid_out, f"{note}.")


def verdicts(by_source: dict[str, Runs]) -> Section:
    """List the figures that each change helps or harms over the sequences; it has no clear effect on the others."""
    laid_out = []
    for changed, against in dict.fromkeys(pair for runs in by_source.values() for pair in compared(runs)):
        effects = pooled([*by_source.values()], changed, against)
        by = [[e for e in effects if e.verdict == word] for word in ("helps", "harms")]
        cells = [", ".join(f"{e.figure.title} ({e.written()})" for e in found) or "–" for found in by]
        laid_out.append([f"{changed} against {against}", *cells])
    note = (
        f"Over {len(by_source)} sequences: *helps*, *harms* if the 95 % t interval of the sequences' mean differences "
        f"excludes 0; {CHANCE:.0%} of figures do so by chance. No clear effect on all others."
    )
    return Section("Verdicts", ["change", "helps", "harms"], laid_out, note)


def pooled(by_source: Sequence[Runs], changed: str, against: str) -> list[PairedDifference]:
    """Return how a change affects each judged figure over the sequences that have it."""
    found = [effect for runs in by_source for effect in paired_differences(runs, changed, against)]
    names = dict.fromkeys(effect.figure.name for effect in found)
    same = ([effect for effect in found if effect.figure.name == name] for name in names)
    return [over_sequences(effects) for effects in same if len(effects) > 1]


def verdict_counts(measured: dict[str, Any], changed: str, against: str) -> Counter[str]:
    """Count the verdicts on a change, over the sequences, of all judged figures."""
    runs = measured["figures"]["runs"]
    sources = dict.fromkeys(run["source"] for run in runs)
    by_source = [[run for run in runs if run["source"] == source] for source in sources]
    return Counter(effect.verdict for effect in pooled(by_source, changed, against))


def compared(runs: Runs) -> list[tuple[str, str]]:
    """List the pairs of variants to compare, of those that were run."""
    there = set(variants(runs))
    return [pair for pair in COMPARED if set(pair) <= there]


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 2 if the options are invalid."""
    try:
        options.run(Screen())
    except SigmaSplatError as problem:
        return program.refuse("ablation", problem)
    figures = kept(record.read(options.working_file()))
    print(tables.table(program.keep("ablation", figures, options, range(options.seeds))))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
