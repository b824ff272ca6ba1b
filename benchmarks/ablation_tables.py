"""Lay out an ablation: mean ± standard deviation of every variant, a table a sequence, then what each weight does."""

from typing import Any

from tables import Section

from sigmasplat.evaluation.ablation import COMPARED, NAMES, WITHOUT_VARIANCE
from sigmasplat.evaluation.paired_comparison import FIGURES, columns, paired_differences, passed_by_chance, rows

Runs = list[dict[str, Any]]
JUDGED = tuple(figure for figure in FIGURES if figure.judged)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by ablation.py: one per sequence, `Effects`, and `Verdicts` in words."""
    runs = measured["figures"]["runs"]
    sources = list(dict.fromkeys(run["source"] for run in runs))
    by_source = {source: [run for run in runs if run["source"] == source] for source in sources}
    seeds, tau = len(measured["seeds"]), measured["config"]["tau"]
    made = [sequence(source, found, tau) for source, found in by_source.items()]
    return [*made, effects_of(by_source, seeds), *([verdicts(by_source)] if seeds > 1 else [])]


def variants(runs: Runs) -> list[str]:
    """List the variants that were run, in the table's order."""
    return [name for name in (WITHOUT_VARIANCE, *NAMES) if any(run["variant"] == name for run in runs)]


def sequence(source: str, runs: Runs, tau: float) -> Section:
    """Lay out a sequence, a row a variant, the best of each column in bold."""
    figures, seeds = columns(runs), len({run["seed"] for run in runs})
    laid_out = rows(runs, variants(runs), lambda text: f"**{text}**", figures)
    note = f"Mean ± standard deviation of {seeds} seeds, τ = {tau:g} in every weight. Views are held out."
    worlds = len({run["path"] for run in runs})
    note += f" {worlds} worlds, one a seed." if worlds > 1 else ""
    return Section(source, ["weights of σ²", *(figure.head for figure in figures)], laid_out, note)


def effects_of(by_source: dict[str, Runs], seeds: int) -> Section:
    """Lay out differences at equal seeds, those beyond one standard deviation in bold."""
    laid_out = []
    for source, runs in by_source.items():
        for changed, against in compared(runs):
            found = {effect.figure.name: effect for effect in paired_differences(runs, changed, against)}
            cells = [found[figure.name].written() if figure.name in found else "–" for figure in JUDGED]
            bold = [figure.name in found and found[figure.name].verdict in ("helps", "harms") for figure in JUDGED]
            shown = [f"**{cell}**" if stands_out else cell for cell, stands_out in zip(cells, bold, strict=True)]
            laid_out.append([source, f"{changed} against {against}", *shown])
    note = "Mean ± standard deviation of the differences at equal seeds"
    if seeds > 1:
        note += f"; bold: the mean is beyond one deviation, as {passed_by_chance(seeds):.0%} of figures are by chance"
    return Section("Effects", ["sequence", "change", *(figure.title for figure in JUDGED)], laid_out, f"{note}.")


def verdicts(by_source: dict[str, Runs]) -> Section:
    """Say on which sequences a change helps or harms which figure beyond one deviation, and where it does neither."""
    laid_out = []
    for changed, against in dict.fromkeys(pair for runs in by_source.values() for pair in compared(runs)):
        helped, harmed, neither = [], [], []
        for source, runs in by_source.items():
            found = paired_differences(runs, changed, against)
            helped += [f"{source}: {effect.figure.title}" for effect in found if effect.verdict == "helps"]
            harmed += [f"{source}: {effect.figure.title}" for effect in found if effect.verdict == "harms"]
            stands_out = any(effect.verdict in ("helps", "harms") for effect in found)
            neither += [] if stands_out else [source]
        cells = [", ".join(names) or "–" for names in (helped, harmed, neither)]
        laid_out.append([f"{changed} against {against}", *cells])
    return Section("Verdicts", ["change", "helps", "harms", "no effect beyond the seeds"], laid_out)


def compared(runs: Runs) -> list[tuple[str, str]]:
    """List which variant is judged against which, of those that were run."""
    there = set(variants(runs))
    return [pair for pair in COMPARED if set(pair) <= there]
