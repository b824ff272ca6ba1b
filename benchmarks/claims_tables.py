"""Compare the claims of both papers with what was measured here: one table over several results, with verdicts.

`tables.py` writes it into docs/results/claims.md. No verdict is typed: each follows from the
differences at equal seeds by the rule of `verdict`.
"""

import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import record
from claims_evidence import Claim, Evidence
from claims_papers import ATE, CHAMFER, CPU, DEPTH, ERROR, FLOATERS, HOPS, PAPERS, PSNR, RANK, SPLATS, STEPS
from paired_comparison import (
    Figure,
    PairedDifference,
    by_seed,
    deviation,
    passed_by_chance,
    rows,
)
from result_pages import link
from tables import Section

LEAST_SEEDS = 3
NOT_MEASURABLE = "not measurable here"


# ---- verdicts ----


def differences(evidence: Evidence, measured: dict[str, Any]) -> dict[str, PairedDifference]:
    """Return the difference at equal seeds for each sequence with enough seeds."""
    found = {}
    runs = evidence.read(measured)
    for source in dict.fromkeys(run["source"] for run in runs):
        here = [run for run in runs if run["source"] == source and run["figures"].get(evidence.figure.name) is not None]
        values = by_seed(here, evidence.changed, evidence.figure)
        if evidence.against is not None:
            base = by_seed(here, evidence.against, evidence.figure)
            values = {seed: value - base[seed] for seed, value in values.items() if seed in base}
        if len(values) >= LEAST_SEEDS:
            each = [*values.values()]
            found[source] = PairedDifference(evidence.figure, statistics.fmean(each), deviation(each))
    return found


def sign(difference: PairedDifference) -> int:
    """Return +1 or −1 if the mean is larger than one deviation, by its sign; otherwise 0."""
    beyond = abs(difference.mean) > (difference.deviation or 0.0)
    return (1 if difference.mean > 0 else -1) if beyond else 0


def agreement(claim: Claim, found: Sequence[PairedDifference]) -> tuple[int, int]:
    """Return on how many sequences the difference is as claimed, and on how many the opposite, beyond one deviation.

    "no worse" holds within one deviation too.
    """
    signs = [sign(difference) for difference in found]
    if claim.claimed == "no worse":
        worse = sum(s * d.figure.better < 0 for s, d in zip(signs, found, strict=True))
        return len(found) - worse, worse
    wanted = 1 if claim.claimed == "more" else -1
    return signs.count(wanted), signs.count(-wanted)


def verdict(claim: Claim, found: Sequence[PairedDifference]) -> str:
    """Return the verdict on a claim from its differences, one for each sequence.

    *reproduced*: as claimed on more than half of the sequences; *the opposite*: the opposite on more than half;
    otherwise *not reproduced*.
    """
    if not found:
        return "not measured yet"
    held, opposite = agreement(claim, found)
    if 2 * held > len(found):
        return "reproduced"
    return "the opposite" if 2 * opposite > len(found) else "not reproduced"


def counted(claim: Claim, found: Sequence[PairedDifference]) -> str:
    """Count the sequences as claimed and those with the opposite; the others are within one deviation."""
    held, opposite = agreement(claim, found)
    if claim.claimed == "no worse":
        return f"worse on {opposite} of {len(found)}"
    return f"as claimed on {held} of {len(found)}" + (f", the opposite on {opposite}" if opposite else "")


def verdict_counts(paper: str, folder: Path = record.RESULTS) -> Counter[str]:
    """Count the verdicts on the claims of a paper. Raises KeyError if results are missing."""
    return Counter(judged(claim, folder)[0] for claim in PAPERS[paper])


def judged(claim: Claim, folder: Path) -> tuple[str, dict[str, PairedDifference]]:
    """Return the verdict on a claim and its differences by sequence. Raises KeyError if its results are missing."""
    if claim.evidence is None:
        return NOT_MEASURABLE, {}
    measured = results_of(claim.evidence, folder)
    found = differences(claim.evidence, measured)
    if found and not any(values_of(claim.evidence, measured)):
        return NOT_MEASURABLE, {}
    return verdict(claim, [*found.values()]), found


def results_of(evidence: Evidence, folder: Path) -> dict[str, Any]:
    """Return the results that evidence is in. Raises KeyError if they are missing."""
    measured = record.latest(evidence.results, folder)
    if measured is None:
        raise KeyError(f"the table of claims needs the results {evidence.results!r}")
    return measured


def row(claim: Claim, folder: Path) -> list[str]:
    """Return the row of a claim. Raises KeyError if its results are missing."""
    evidence, (judgement, found) = claim.evidence, judged(claim, folder)
    if evidence is None:
        return [claim.said, claim.published, f"– ({claim.remark})", judgement, "–"]
    results = link(evidence.results)
    if not found:
        why = f"{evidence.figure.title}: 0 in all runs" if judgement == NOT_MEASURABLE else "–"
        return [claim.said, claim.published, why, judgement, results]
    measured = results_of(evidence, folder)
    cells = [f"{source} {_written(difference)}" for source, difference in found.items()]
    title = evidence.figure.title + (f", {evidence.figure.unit}" if evidence.figure.unit else "")
    what = f"{evidence.changed} − {evidence.against}" if evidence.against else evidence.changed
    text = f"{title}, *{what}*: {'; '.join(cells)}" + (f" ({claim.remark})" if claim.remark else "")
    counts = counted(claim, [*found.values()])
    provenance = f"{results}, {seeds(evidence, measured)} {evidence.repeats}, {(measured['commit'] or 'no commit')[:9]}"
    return [claim.said, claim.published, text, f"**{judgement}**: {counts}", provenance]


def values_of(evidence: Evidence, measured: dict[str, Any]) -> list[float]:
    """Return the figure of every run of the compared variants that has it."""
    both, name = (evidence.changed, evidence.against), evidence.figure.name
    found = [run["figures"].get(name) for run in evidence.read(measured) if run["variant"] in both]
    return [float(value) for value in found if value is not None]


def seeds(evidence: Evidence, measured: dict[str, Any]) -> int:
    """Return the number of seeds of the sequence that has the fewest, of those that count."""
    runs = [run for run in evidence.read(measured) if run["variant"] == evidence.changed]
    counts = [len({r["seed"] for r in runs if r["source"] == source}) for source in differences(evidence, measured)]
    return min(counts)


def _written(difference: PairedDifference) -> str:
    text = difference.written().removesuffix(difference.figure.unit).rstrip()
    return f"**{text}**" if sign(difference) else text


HEAD = ["claim", "paper", "measured here: difference at equal seeds, mean ± standard deviation", "verdict", "results"]


def table(folder: Path = record.RESULTS) -> str:
    """Write the claims of both papers as markdown tables. Raises KeyError if results are missing."""
    made = []
    for paper, claims in PAPERS.items():
        lines = [HEAD, ["---"] * len(HEAD), *(row(claim, folder) for claim in claims)]
        made.append(f"**{paper}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines))
    return "\n" + "\n".join(made) + f"\n{note()}\n\n"


def note() -> str:
    """Return the rule of the verdicts in words."""
    return (
        "**Bold** differences are larger than one standard deviation, which "
        f"{passed_by_chance(LEAST_SEEDS):.0%} of differences are by chance with {LEAST_SEEDS} seeds. *Reproduced*: the "
        "difference has the claimed sign and is larger than one standard deviation on more than half of the sequences. "
        "*The opposite*: the same with the opposite sign. Otherwise *not reproduced*. A claim that something is not "
        "worse is reproduced if the difference is not worse by more than one standard deviation on more than half of "
        f"the sequences. A sequence with fewer than {LEAST_SEEDS} seeds does not count. Results without a link are in "
        "`benchmarks/results/` only."
    )


# ---- the results of claims.py alone ----


VALUES: dict[str, tuple[Figure, ...]] = {
    "varsplat": (ATE, PSNR, DEPTH, RANK, CPU),
    "cgslam": (ATE, CHAMFER, FLOATERS, PSNR, DEPTH, SPLATS, CPU),
    "hops": (HOPS,),
    "registration": (
        ERROR,
        Figure("registration_deg", "error of rotation", "°", -1),
        Figure("accepted", "accepted", "", +1, digits=1),
        Figure("pairs", "pairs", "", 0, digits=1),
    ),
    "localisation": (
        Figure("localised_m", "error", "cm", -1, 100.0, digits=3),
        STEPS,
    ),
}
TITLES = {
    "varsplat": "VarSplat by descent", "cgslam": "CG-SLAM by descent", "hops": "Hops",
    "registration": "Registrations", "localisation": "Localisations",
}  # fmt: skip


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the values that claims.py measured: a table for each kind and sequence."""
    runs, made = measured["figures"]["runs"], []
    for group, figures in VALUES.items():
        for source in dict.fromkeys(run["source"] for run in runs if run["group"] == group):
            found = [run for run in runs if (run["group"], run["source"]) == (group, source)]
            found = [run | {"figures": {f.name: run["figures"].get(f.name) for f in figures}} for run in found]
            shown = [f for f in figures if any(run["figures"][f.name] is not None for run in found)]
            variants = list(dict.fromkeys(run["variant"] for run in found))
            note = f"Mean ± standard deviation of {len({run['seed'] for run in found})} seeds."
            laid_out = rows(found, variants, lambda text: f"**{text}**", shown)
            made.append(Section(f"{TITLES[group]}, {source}", ["variant", *(f.head for f in shown)], laid_out, note))
    return made
