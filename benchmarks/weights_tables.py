"""Tabulate the results of weights.py: values, differences at equal seeds, and verdicts over all sequences."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from paired_comparison import (
    Figure,
    PairedDifference,
    by_seed,
    deviation,
    passed_by_chance,
    rows,
)
from tables import Section
from weights import DEFAULT

Runs = list[dict[str, Any]]
FIGURES: dict[str, tuple[Figure, ...]] = {
    "path": (
        Figure("ate_m", "ATE", "cm", -1, 100.0),
        Figure("rpe_m", "RPE", "mm", -1, 1000.0),
        Figure("rpe_deg", "RPE of rotation", "°", -1, digits=3),
        Figure("psnr_before_db", "PSNR of submaps", "dB", +1),
        Figure("depth_l1_before_m", "depth L1 of submaps", "cm", -1, 100.0),
        Figure("psnr_db", "PSNR", "dB", +1),
        Figure("depth_l1_m", "depth L1", "cm", -1, 100.0),
        Figure("lost", "lost", "", -1, digits=1, judged=False),
        Figure("loops", "loops", "", 0, digits=1, judged=False),
        Figure("splats", "splats", "k", 0, 1e-3, digits=1, judged=False),
    ),
    "final": (
        Figure("psnr_db", "PSNR", "dB", +1),
        Figure("depth_l1_m", "depth L1", "cm", -1, 100.0),
        Figure("splats", "splats", "k", 0, 1e-3, digits=1, judged=False),
    ),
    "registration": (
        Figure("registration_m", "error", "cm", -1, 100.0),
        Figure("registration_deg", "error of rotation", "°", -1),
        Figure("accepted", "accepted", "", +1, digits=1),
        Figure("pairs", "pairs", "", 0, digits=1, judged=False),
    ),
    "gate": (Figure("average_precision", "average precision", "%", +1, 100.0),),
}
"""Figures by what is measured; those of views are of held-back frames, "of submaps" before the final map is made."""
TITLES = {"path": "Complete runs", "final": "Final maps", "registration": "Registrations", "gate": "Loop gate"}


@dataclass(frozen=True)
class Change:
    """Two variants to compare: what `changed` differs in from `against`, in words."""

    what: str
    group: str
    changed: str
    against: str


CHANGES = (
    Change("all weights by V", "path", DEFAULT, "no weights at all"),
    Change("tracking by V", "path", DEFAULT, "tracking: no weights"),
    Change("tracking: depth by U instead of V", "path", "tracking: depth by U", DEFAULT),
    Change("mapping: U in the loss", "path", DEFAULT, "mapping: no U"),
    Change("mapping: alignment in the loss", "path", "mapping: with alignment", DEFAULT),
    Change("pruning: fading by ν", "path", DEFAULT, "pruning: no fading"),
    Change("registration by V", "registration", "V", "no weights"),
    Change("registration by V, τ 2", "registration", "V, τ 2", "no weights"),
    Change("loop gate by σ²", "gate", "V", "no weights"),
    Change("loop gate by σ², τ 2", "gate", "V, τ 2", "no weights"),
    Change("merging and refinement by σ²", "final", "V", "no weights"),
)  # fmt: skip


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results: verdicts, differences of each kind, and the values of each sequence."""
    runs = measured["figures"]["runs"]
    made = [verdicts(runs), *(mean_of_sequences(runs, group) for group in FIGURES)]
    made += [differences(runs, group) for group in FIGURES]
    made += [values(runs, group, source) for group in FIGURES for source in sources_of(runs)]
    return [section for section in made if section.rows]


def sources_of(runs: Runs) -> list[str]:
    """List the sequences in the order of the runs."""
    return list(dict.fromkeys(run["source"] for run in runs))


def of(runs: Runs, group: str, source: str) -> Runs:
    """Return the rows of one kind and sequence."""
    return [run for run in runs if run["group"] == group and run["source"] == source]


def difference(runs: Runs, change: Change, figure: Figure) -> PairedDifference | None:
    """Return the paired difference of a change on one sequence; None without seeds that both variants have."""
    changed, against = by_seed(runs, change.changed, figure), by_seed(runs, change.against, figure)
    found = [changed[seed] - against[seed] for seed in against if seed in changed]
    return PairedDifference(figure, statistics.fmean(found), deviation(found)) if found else None


def verdicts(runs: Runs) -> Section:
    """List where each change makes figures better or worse beyond the seeds, and a verdict."""
    laid_out = []
    for change in CHANGES:
        found = found_of(runs, change)
        if found:
            better, worse = (
                {s: names for s, names in by.items() if names} for by in (named(found, "helps"), named(found, "harms"))
            )
            cells = [
                "; ".join(f"{source}: {', '.join(names)}" for source, names in by.items()) for by in (better, worse)
            ]
            judged = judgement(better, worse, len(found))
            laid_out.append([change.what, judged, f"{common_seeds(runs, change)}", *(cell or "–" for cell in cells)])
    seeds = len({run["seed"] for run in runs})
    note = (
        "Beyond the seeds: the mean of the differences at equal seeds exceeds their standard deviation; "
        f"{passed_by_chance(seeds):.0%} of figures do so by chance. *helps*: at least a fifth of all figures, on at "
        "least two sequences, are better beyond the seeds, and at most a quarter as many are worse; *hurts*: the "
        "opposite. Otherwise *no effect* if at most a quarter of all figures differ beyond the seeds, else *mixed*."
    )
    head = ["change", "verdict", "seeds", "better beyond the seeds", "worse beyond the seeds"]
    return Section("Verdicts", head, laid_out, note if seeds > 1 else "")


def common_seeds(runs: Runs, change: Change) -> int:
    """Return the number of seeds that both variants have on every sequence."""
    keys = [{(r["source"], r["seed"]) for r in runs if r["group"] == change.group and r["variant"] == v}
            for v in (change.changed, change.against)]  # fmt: skip
    both = keys[0] & keys[1]
    return min(sum(source == s for s, _ in both) for source in {s for s, _ in both})


def found_of(runs: Runs, change: Change) -> list[tuple[str, PairedDifference]]:
    """Return the paired differences of a change with their sequences, over all judged figures."""
    judged = [figure for figure in FIGURES[change.group] if figure.judged]
    pairs = ((s, difference(of(runs, change.group, s), change, figure)) for s in sources_of(runs) for figure in judged)
    return [(source, found) for source, found in pairs if found]


def named(found: Sequence[tuple[str, PairedDifference]], verdict: str) -> dict[str, list[str]]:
    """Return the titles of the figures with a verdict, by sequence."""
    return {
        source: [d.figure.title for s, d in found if s == source and d.verdict == verdict]
        for source in dict.fromkeys(source for source, _ in found)
    }


def judgement(better: Mapping[str, Sequence[str]], worse: Mapping[str, Sequence[str]], compared: int) -> str:
    """Return the verdict on a change from the figures that it makes better and worse, by sequence; compared: the number
    of all figures."""
    gains, losses = (sum(map(len, by.values())) for by in (better, worse))
    if len(better) > 1 and 5 * gains >= compared and 4 * losses <= gains:
        return "helps"
    if len(worse) > 1 and 5 * losses >= compared and 4 * gains <= losses:
        return "hurts"
    return "no effect" if 4 * (gains + losses) <= compared else "mixed"


def mean_of_sequences(runs: Runs, group: str) -> Section:
    """Tabulate the mean of the differences over the sequences, in percent of the value without the change."""
    judged, laid_out = [figure for figure in FIGURES[group] if figure.judged], list[list[str]]()
    for change in (change for change in CHANGES if change.group == group):
        found = [[relative(of(runs, group, source), change, f) for source in sources_of(runs)] for f in judged]
        known = [[value for value in values if value is not None] for values in found]
        if any(known):
            laid_out.append([change.what, *map(pooled, judged, known)])
    note = "Mean ± standard deviation over the sequences of the mean differences; bold: larger than one deviation."
    return Section(f"{TITLES[group]}, mean of sequences", ["change", *(f.title for f in judged)], laid_out, note)


def relative(runs: Runs, change: Change, figure: Figure) -> float | None:
    """Return the mean difference of a change in percent of the mean before; decibels as they are."""
    found, before = difference(runs, change, figure), list(by_seed(runs, change.against, figure).values())
    if found is None or figure.unit == "dB":
        return None if found is None else found.mean
    level = statistics.fmean(before)
    return 100.0 * found.mean / level if level else None


def pooled(figure: Figure, values: Sequence[float]) -> str:
    """Format mean ± standard deviation over the sequences; bold if the mean is larger."""
    unit = figure.unit if figure.unit == "dB" else "%"
    shown = replace(figure, unit=unit, digits=2 if unit == "dB" else 1)
    return written(PairedDifference(shown, statistics.fmean(values), deviation(values)) if values else None)


def differences(runs: Runs, group: str) -> Section:
    """Tabulate the differences at equal seeds of one kind; those beyond the seeds are bold."""
    judged, laid_out = [figure for figure in FIGURES[group] if figure.judged], []
    for change in (change for change in CHANGES if change.group == group):
        for source in sources_of(runs):
            found = [difference(of(runs, group, source), change, figure) for figure in judged]
            if any(found):
                laid_out.append([change.what, source, *map(written, found)])
    note = "Mean ± standard deviation of the differences at equal seeds; bold: beyond the seeds."
    title = f"{TITLES[group]}, differences"
    return Section(title, ["change", "sequence", *(figure.title for figure in judged)], laid_out, note)


def written(found: PairedDifference | None) -> str:
    """Format a difference; bold if it is beyond the seeds, a dash without one."""
    if found is None:
        return "–"
    return f"**{found.written()}**" if found.verdict in ("helps", "harms") else found.written()


def values(runs: Runs, group: str, source: str) -> Section:
    """Tabulate the values of one kind on a sequence: one row per variant, the best of each column bold."""
    found = of(runs, group, source)
    variants, figures = list(dict.fromkeys(run["variant"] for run in found)), FIGURES[group]
    laid_out = rows(found, variants, lambda text: f"**{text}**", figures)
    note = f"Mean ± standard deviation of {len({run['seed'] for run in found})} seeds."
    return Section(f"{TITLES[group]}, {source}", ["variant", *(f.head for f in figures)], laid_out, note)
