"""Compare the claims of both papers with what was measured here: one table over several results, with verdicts.

`tables.py` writes it into docs/results/claims.md, and lists of what holds into docs/claims.md. No verdict is typed:
each follows from the differences at equal seeds by the rule of `verdict`.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import record
from claims_evidence import Claim, Evidence
from claims_papers import ATE, CHAMFER, CPU, DEPTH, ERROR, FLOATERS, HOPS, PAPERS, PSNR, RANK, SPLATS, STEPS
from paired_comparison import Figure, PairedDifference, by_seed, difference, interval, over_sequences, rows
from result_pages import link
from tables import Section

from sigmasplat.run.figures import number

LEAST_SEEDS = 3
HOLDS, OPPOSITE, UNCLEAR = "holds", "the opposite", "no clear effect"
ONE_SEQUENCE = "one sequence only: not tested"
FEW_SEEDS = f"fewer than {LEAST_SEEDS} seeds: not tested"
NOT_MEASURABLE = "not measurable here"
MARGINS = {"%": 5.0, "dB": 0.42}
"""How much worse "not worse" may be: an error 5 % larger, which is 0.42 dB for the RMSE of colours."""


# ---- verdicts ----


def differences(evidence: Evidence, measured: dict[str, Any]) -> dict[str, PairedDifference]:
    """Return the differences at equal seeds of each sequence, or the values if nothing is compared."""
    found = {}
    runs = evidence.read(measured)
    for source in dict.fromkeys(run["source"] for run in runs):
        here = [run for run in runs if run["source"] == source]
        if evidence.against is None:
            values = tuple(by_seed(here, evidence.changed, evidence.figure).values())
            compared = PairedDifference(evidence.figure, values) if values else None
        else:
            compared = difference(here, evidence.changed, evidence.against, evidence.figure)
        if compared:
            found[source] = compared
    return found


def counting(found: dict[str, PairedDifference]) -> list[PairedDifference]:
    """Return the differences of the sequences that have enough seeds to count."""
    return [difference for difference in found.values() if len(difference.each) >= LEAST_SEEDS]


def verdict(claim: Claim, found: Sequence[PairedDifference]) -> str:
    """Return the verdict on a claim from its differences, one for each sequence with enough seeds.

    *holds*: the 95 % t interval of the sequences' means lies on the claimed side of 0 (of the margin, if the claim is
    that something is not worse); *the opposite*: on the other side of 0; otherwise *no clear effect*.
    """
    if len(found) < 2:
        return ONE_SEQUENCE
    pooled = over_sequences(found)
    low, high = interval(pooled.each) or (0.0, 0.0)
    wanted = {"more": 1, "less": -1, "no worse": pooled.figure.better}[claim.claimed]
    low, high = sorted((wanted * low, wanted * high))
    if low > (-MARGINS[pooled.figure.unit] if claim.claimed == "no worse" else 0.0):
        return HOLDS
    return OPPOSITE if high < 0 else UNCLEAR


def verdict_counts(paper: str, folder: Path = record.RESULTS) -> Counter[str]:
    """Count the verdicts on the claims of a paper. Raises KeyError if results are missing."""
    return Counter(judged(claim, folder)[0] for claim in PAPERS[paper])


def judged(claim: Claim, folder: Path) -> tuple[str, dict[str, PairedDifference]]:
    """Return the verdict on a claim and its differences by sequence. Raises KeyError if its results are missing."""
    if claim.evidence is None:
        return NOT_MEASURABLE, {}
    measured = results_of(claim.evidence, folder)
    found = differences(claim.evidence, measured)
    if not any(values_of(claim.evidence, measured)):
        return NOT_MEASURABLE, {}
    enough = counting(found)
    return verdict(claim, enough) if enough else FEW_SEEDS, found


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
        return [claim.said, claim.published, "–", f"– ({claim.remark})", "–", judgement, "–"]
    results, measured = link(evidence.results), results_of(evidence, folder)
    family = evidence.family(measured)
    if not found:
        return [claim.said, claim.published, family, f"{evidence.figure.title}: 0 in all runs", "–", judgement, results]
    cells = [f"{source} {_written(difference)}" for source, difference in found.items()]
    title = evidence.figure.title + (f", {evidence.figure.unit}" if evidence.figure.unit else "")
    what = f"{evidence.changed} − {evidence.against}" if evidence.against else evidence.changed
    text = f"{title}, *{what}*: {'; '.join(cells)}" + (f" ({claim.remark})" if claim.remark else "")
    seeds = min(len(difference.each) for difference in counting(found) or found.values())
    provenance = f"{results}, {seeds} seeds, {(measured['commit'] or 'no commit')[:9]}"
    return [claim.said, claim.published, family, text, effect(found), f"**{judgement}**", provenance]


def effect(found: dict[str, PairedDifference]) -> str:
    """Return the mean over sequences and its 95 % interval; a dash for a single sequence."""
    enough = counting(found)
    if len(enough) < 2:
        return "–"
    pooled = over_sequences(enough)
    low, high = interval(pooled.each) or (0.0, 0.0)
    mean, low_text, high_text = (number(value, pooled.figure.digits) for value in (pooled.mean, low, high))
    return f"{mean} [{low_text}…{high_text}] {pooled.figure.unit}".rstrip()


def values_of(evidence: Evidence, measured: dict[str, Any]) -> list[float]:
    """Return the figure of every run of the compared variants that has it."""
    both, name = (evidence.changed, evidence.against), evidence.figure.name
    found = [run["figures"].get(name) for run in evidence.read(measured) if run["variant"] in both]
    return [float(value) for value in found if value is not None]


def _written(difference: PairedDifference) -> str:
    text = difference.written().removesuffix(difference.figure.unit).rstrip().replace(" ± ", "±")
    return f"**{text}**" if difference.stands_out else text


HEAD = [
    "claim", "paper", "settings", "difference at equal seeds, mean ± standard deviation",
    "over sequences, 95 % interval", "verdict", "results",
]  # fmt: skip


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
        "[The rule of the verdicts](../claims.md#the-rule). **Bold** differences: the 95 % t interval over the seeds "
        f"of this sequence excludes 0. A sequence with fewer than {LEAST_SEEDS} seeds does not count. Results without "
        "a link are in `benchmarks/results/` only."
    )


LISTS = {
    "What holds": {HOLDS: ""},
    "What does not": {OPPOSITE: "the opposite", UNCLEAR: "no clear effect"},
    "What could not be tested": {
        ONE_SEQUENCE: "one sequence only", FEW_SEEDS: f"fewer than {LEAST_SEEDS} seeds",
        NOT_MEASURABLE: "not measurable here",
    },
}  # fmt: skip
"""Lists of docs/claims.md: their title, and the verdicts in them with their words."""


def lists(folder: Path = record.RESULTS) -> str:
    """Write what holds, what does not, and what could not be tested. Raises KeyError if results are missing."""
    families = [
        claim.evidence.family(results_of(claim.evidence, folder))
        for claims in PAPERS.values() for claim in claims if claim.evidence
    ]  # fmt: skip
    own = sum(not family.startswith("other") for family in families)
    made = [
        f"**{own} of {len(families)} measured claims were measured with the paper's own iterations and rates** at 320 "
        "pixels or more. The others judge shorter runs of other settings, not the paper.\n"
    ]
    for title, verdicts in LISTS.items():
        lines, count = [], 0
        for paper, claims in PAPERS.items():
            for judgement, word in verdicts.items():
                said = [
                    claim.said + (f" ({shown})" if (shown := effect(found)) != "–" and judgement != UNCLEAR else "")
                    for claim, (found_judgement, found) in ((claim, judged(claim, folder)) for claim in claims)
                    if found_judgement == judgement
                ]
                count += len(said)
                lines += [f"- **{paper}**{word and f', {word}'}: {'; '.join(said)}.\n"] if said else []
        made.append(f"## {title}: {count}\n\n{''.join(lines)}")
    return "\n" + "\n".join(made) + "\n"


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
