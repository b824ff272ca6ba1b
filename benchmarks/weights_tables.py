"""Tabulate the results of weights.py: values, differences at equal seeds, and verdicts over all sequences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from paired_comparison import CHANCE, Figure, PairedDifference, difference, over_sequences, rows
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


def verdicts(runs: Runs) -> Section:
    """List the figures that each change makes better or worse over the sequences, and a verdict."""
    laid_out = []
    for change in CHANGES:
        found = pooled(runs, change)
        if found:
            by = {word: [d for d in found if d.judged(CHANCE / len(found)) == word] for word in ("helps", "harms")}
            cells = ["; ".join(f"{d.figure.title} ({d.written()})" for d in by[word]) or "–" for word in by]
            laid_out.append([change.what, judgement(found), f"{common_seeds(runs, change)}", *cells])
    note = (
        "Better, worse: the t interval of the sequences' mean differences excludes 0, at "
        f"{100 * (1 - CHANCE):.0f} % for all figures of a change together (Bonferroni). *mixed*: better and worse."
    )
    head = ["change", "verdict", "seeds", "better", "worse"]
    return Section("Verdicts", head, laid_out, note if len(sources_of(runs)) > 1 else "")


def common_seeds(runs: Runs, change: Change) -> int:
    """Return the number of seeds that both variants have on every sequence."""
    keys = [{(r["source"], r["seed"]) for r in runs if r["group"] == change.group and r["variant"] == v}
            for v in (change.changed, change.against)]  # fmt: skip
    both = keys[0] & keys[1]
    return min(sum(source == s for s, _ in both) for source in {s for s, _ in both})


def pooled(runs: Runs, change: Change) -> list[PairedDifference]:
    """Return how a change affects each judged figure over the sequences that have it."""
    of_figures = (of_sequences(runs, change, figure) for figure in FIGURES[change.group] if figure.judged)
    return [over_sequences(found) for found in of_figures if len(found) > 1]


def of_sequences(runs: Runs, change: Change, figure: Figure) -> list[PairedDifference]:
    """Return how a change affects a figure, sequence by sequence."""
    found = (
        difference(of(runs, change.group, source), change.changed, change.against, figure)
        for source in sources_of(runs)
    )
    return [of_sequence for of_sequence in found if of_sequence is not None]


def judgement(found: Sequence[PairedDifference]) -> str:
    """Return the verdict on a change from its figures over the sequences, each judged at its share of `CHANCE`."""
    verdicts = {difference.judged(CHANCE / len(found)) for difference in found}
    if {"helps", "harms"} <= verdicts:
        return "mixed"
    return next((word for word in ("helps", "harms") if word in verdicts), "no clear effect")


def mean_of_sequences(runs: Runs, group: str) -> Section:
    """Tabulate the mean of the differences over the sequences, in percent of the value without the change."""
    judged, laid_out = [figure for figure in FIGURES[group] if figure.judged], list[list[str]]()
    for change in (change for change in CHANGES if change.group == group):
        found = [of_sequences(runs, change, figure) for figure in judged]
        if any(found):
            laid_out.append([change.what, *(written(over_sequences(of) if of else None) for of in found)])
    note = "Mean ± standard deviation over the sequences of the mean differences; bold: its 95 % t interval excludes 0."
    return Section(f"{TITLES[group]}, mean of sequences", ["change", *(f.title for f in judged)], laid_out, note)


def differences(runs: Runs, group: str) -> Section:
    """Tabulate the differences at equal seeds of one kind; those that show an effect are bold."""
    judged, laid_out = [figure for figure in FIGURES[group] if figure.judged], []
    for change in (change for change in CHANGES if change.group == group):
        for source in sources_of(runs):
            here = of(runs, group, source)
            found = [difference(here, change.changed, change.against, figure) for figure in judged]
            if any(found):
                laid_out.append([change.what, source, *map(written, found)])
    note = "Mean ± standard deviation of the differences at equal seeds; bold: their 95 % t interval excludes 0."
    title = f"{TITLES[group]}, differences"
    return Section(title, ["change", "sequence", *(figure.title for figure in judged)], laid_out, note)


def written(found: PairedDifference | None) -> str:
    """Format a difference; bold if it shows an effect, a dash without one."""
    if found is None:
        return "–"
    return f"**{found.written()}**" if found.stands_out else found.written()


def values(runs: Runs, group: str, source: str) -> Section:
    """Tabulate the values of one kind on a sequence: one row per variant, the best of each column bold."""
    found = of(runs, group, source)
    variants, figures = list(dict.fromkeys(run["variant"] for run in found)), FIGURES[group]
    laid_out = rows(found, variants, lambda text: f"**{text}**", figures)
    note = f"Mean ± standard deviation of {len({run['seed'] for run in found})} seeds."
    return Section(f"{TITLES[group]}, {source}", ["variant", *(f.head for f in figures)], laid_out, note)
