"""Compare the claims of both papers with what was measured here: one table over several results, with verdicts.

`tables.py` writes it where a document has <!-- bench:verdicts -->. No verdict is typed: each follows from the
differences at equal seeds by the rule of `verdict`.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import record
from tables import Section

from sigmasplat.evaluation.paired_comparison import (
    Figure,
    PairedDifference,
    by_seed,
    deviation,
    passed_by_chance,
    rows,
)

Runs = list[dict[str, Any]]
"""Runs, each with `source`, `variant`, `seed` and `figures`."""
Claimed = Literal["less", "more", "no worse"]
LEAST_SEEDS = 3
ATE = Figure("ate_m", "ATE", "cm", -1, 100.0)
PSNR = Figure("psnr_db", "PSNR", "dB", +1)
DEPTH = Figure("depth_l1_m", "depth L1", "cm", -1, 100.0)
RANK = Figure("spearman", "Spearman", "", +1, digits=3)
SPLATS = Figure("splats", "splats", "k", -1, 1e-3, digits=1)
CPU = Figure("cpu_s", "CPU time of a frame", "ms", -1, 1000.0, digits=0)
CHAMFER = Figure("splats_chamfer_m", "Chamfer", "cm", -1, 100.0)


# ---- reading the results ----


def of_rows(group: str) -> Callable[[dict[str, Any]], Runs]:
    """Return what reads the rows of one group: results of claims.py and weights.py."""
    return lambda measured: [run for run in measured["figures"]["runs"] if run["group"] == group]


def of_runs(measured: dict[str, Any]) -> Runs:
    """Read the runs of ablation.py."""
    found: Runs = measured["figures"]["runs"]
    return found


def of_jobs(measured: dict[str, Any]) -> Runs:
    """Read the jobs of systems.py; a variant is a preset."""
    return [
        {"source": job["source"], "variant": job["preset"], "seed": job["seed"], "figures": result["figures"]}
        for result, job in ((result, result["job"]) for result in measured["figures"]["jobs"])
        if result["problem"] is None
    ]


def of_scores(quantity: str, pixels: str) -> Callable[[dict[str, Any]], Runs]:
    """Return what reads uncertainty.py: scores of held-back views of final maps; a variant is a predictor."""

    def read(measured: dict[str, Any]) -> Runs:
        return [
            {"source": run["source"], "variant": name, "seed": run["seed"], "figures": scores}
            for run in measured["figures"]["runs"]
            for name, scores in run["scores"][quantity]["final"]["held back"][pixels]["predictors"].items()
        ]

    return read


def of_kinds(measured: dict[str, Any]) -> Runs:
    """Read color_covariance.py; a variant is a kind of covariance."""
    return [
        {"source": source["source"].partition(":")[0], "variant": kind, "seed": run["seed"], "figures": run[kind]}
        for source in measured["figures"]["sources"]
        for run in source["runs"]
        for kind in ("diagonal", "full")
    ]


@dataclass(frozen=True)
class Evidence:
    """Where a figure is measured: results by name, what reads them, and the variants to compare.

    Without `against`, the figure itself is compared with 0.
    """

    results: str
    read: Callable[[dict[str, Any]], Runs]
    figure: Figure
    changed: str
    against: str | None = None


@dataclass(frozen=True)
class Claim:
    """A claim of a paper: what it says, what it publishes and where, the sign that it claims for the measured
    difference, and the evidence; without evidence, `remark` says why it cannot be measured here."""

    said: str
    published: str
    claimed: Claimed
    evidence: Evidence | None
    remark: str = ""


def in_claims(group: str, figure: Figure, changed: str, against: str | None = None) -> Evidence:
    """Return evidence from claims.py."""
    return Evidence("claims", of_rows(group), figure, changed, against)


def in_weights(group: str, figure: Figure, changed: str, against: str) -> Evidence:
    """Return evidence from weights.py, which runs `sigma`."""
    return Evidence("weights", of_rows(group), figure, changed, against)


def in_ablation(changed: str, against: str) -> Evidence:
    """Return evidence on the ATE from ablation.py, which runs `varsplat-fast`."""
    return Evidence("ablation", of_runs, ATE, changed, against)


def in_systems(figure: Figure, changed: str, against: str) -> Evidence:
    """Return evidence from systems.py: one preset against another."""
    return Evidence("systems", of_jobs, figure, changed, against)


# ---- the claims ----


NO_NUMBER = "no number"
NO_DATA = "the data set is not available here; `sigmasplat bench table {}` measures it where the data is"
VARSPLAT = (
    Claim(
        "V ranks the errors of colour",
        NO_NUMBER,
        "more",
        Evidence("uncertainty", of_scores("color", "all pixels"), RANK, "V"),
        "Spearman of V and squared error at held-back views",
    ),
    Claim(
        "a learned σ² makes V rank them better than the scatter of colours alone",
        NO_NUMBER,
        "more",
        in_systems(RANK, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "V in tracking lowers the ATE",
        "ablation, ScanNet: 8.20 → 7.63 cm",
        "less",
        in_claims("varsplat", ATE, "V in tracking", "no weights"),
        "descent through the renderer, as in the paper",
    ),
    Claim(
        "the same, with our alignment of images",
        "as above",
        "less",
        in_weights("path", ATE, "default", "tracking: no weights"),
    ),
    Claim(
        "the loop gate by σ² lowers the ATE",
        "ablation, ScanNet: 7.63 → 7.49 cm",
        "less",
        in_ablation("+loop", "+tracking"),
    ),
    Claim(
        "the loop gate orders candidates better",
        NO_NUMBER,
        "more",
        in_weights(
            "gate", Figure("average_precision", "average precision", "%", +1, 100.0), "V", "no weights"
        ),
    ),
    Claim(
        "V in registration lowers the ATE",
        "ablation, ScanNet: 7.49 → 6.53 cm",
        "less",
        in_ablation("+registration", "+loop"),
    ),
    Claim(
        "V in registration makes registrations more accurate",
        NO_NUMBER,
        "less",
        in_weights("registration", Figure("registration_m", "error", "cm", -1, 100.0), "V", "no weights"),
    ),
    Claim(
        "all weights together lower the ATE",
        "ablation, ScanNet: 8.20 → 6.53 cm",
        "less",
        in_weights("path", ATE, "default", "no weights at all"),
    ),
    Claim(
        "VarSplat's ATE is lower than LoopSplat's",
        "ATE: Replica 0.23 (0.26), TUM 3.20 (3.33), ScanNet++ 1.69 (2.05) cm",
        "less",
        in_systems(ATE, "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "tracking is more robust: fewer frames are lost",
        NO_NUMBER,
        "less",
        in_weights("path", Figure("lost", "lost frames", "", -1, digits=1), "default", "tracking: no weights"),
    ),
    Claim(
        "accumulated tracking uncertainty shows where submaps should end",
        "§2: a rule without a formula",
        "more",
        in_claims("hops", Figure("rank", "Spearman", "", +1, digits=2), "V"),
        "Spearman of the V that a hop adds and its true error",
    ),
    Claim(
        "ours: the covariance of the pose shows it",
        "not in the paper",
        "more",
        in_claims("hops", Figure("rank", "Spearman", "", +1, digits=2), "covariance"),
    ),
    Claim(
        "the likelihood does not make views worse",
        NO_NUMBER,
        "no worse",
        in_claims("varsplat", PSNR, "no weights", "no likelihood"),
    ),
    Claim(
        "views are at least as good as LoopSplat's",
        "Replica: PSNR 37.15 dB, depth L1 0.50 cm",
        "no worse",
        in_systems(Figure("held_out_psnr_db", "PSNR", "dB", +1), "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "the same for depth",
        "as above",
        "no worse",
        in_systems(Figure("held_out_depth_l1_m", "depth L1", "cm", -1, 100.0), "varsplat-fast", "loopsplat-fast"),
    ),
    Claim(
        "variance costs time",
        "runtime, Replica room0: mapping 1.9 (1.2), tracking 2.0 (1.8) s per frame",
        "more",
        in_claims("varsplat", CPU, "V in tracking", "no likelihood"),
    ),
    Claim(
        "the mean of the colour error in registration is over values, 3HW",
        "§5: formula",
        "less",
        in_claims(
            "registration",
            Figure("registration_m", "error", "cm", -1, 100.0),
            "mean over values",
            "mean over pixels",
        ),
    ),
    Claim(
        "localisation may stop on a plateau (ours: 10 steps)",
        "§5: stop at small steps",
        "no worse",
        in_claims("localisation", Figure("localised_m", "error", "cm", -1, 100.0), "window 10", "no stop"),
    ),
    Claim(
        "… which saves steps",
        "as above",
        "less",
        in_claims("localisation", Figure("steps", "steps", "", -1, digits=1), "window 10", "no stop"),
    ),
    Claim(
        "a stop after one step without progress does no harm",
        "not in the paper",
        "no worse",
        in_claims("localisation", Figure("localised_m", "error", "cm", -1, 100.0), "window 1", "no stop"),
    ),
    Claim(
        "ours: merging and refinement by σ² improves views",
        "not used, a named limitation",
        "more",
        in_weights("final", PSNR, "V", "no weights"),
    ),
    Claim(
        "ours: a full colour covariance predicts the errors of colour better",
        "not used, a named limitation",
        "less",
        Evidence("color-covariance", of_kinds, Figure("nll_full", "NLL", "nats", -1), "full", "diagonal"),
    ),
    Claim(
        "ATE on Replica, TUM, ScanNet, ScanNet++",
        "0.23, 3.20, 6.5, 1.69 cm",
        "less",
        None,
        NO_DATA.format("varsplat-replica"),
    ),
    Claim(
        "views and surface on Replica, novel views on ScanNet++",
        "PSNR 37.15 dB, SSIM 0.986, LPIPS 0.109, F1 90.2 %; novel views 21.33 dB",
        "more",
        None,
        NO_DATA.format("varsplat-scannetpp"),
    ),
)  # fmt: skip
CGSLAM = (
    Claim(
        "U ranks the errors of depth",
        NO_NUMBER,
        "more",
        Evidence("uncertainty", of_scores("depth", "covered pixels"), RANK, "U"),
        "Spearman of U and squared error at held-back views; U about the rendered depth",
    ),
    Claim(
        "alignment and variance bring splats to the surface",
        "ablation, Replica: Chamfer 4.79 → 3.85 cm",
        "less",
        in_claims("cgslam", CHAMFER, "full", "without both"),
    ),
    Claim(
        "… alignment alone", "4.74 → 3.85 cm", "less", in_claims("cgslam", CHAMFER, "full", "without alignment")
    ),
    Claim("… variance alone", "4.57 → 3.85 cm", "less", in_claims("cgslam", CHAMFER, "full", "without variance")),
    Claim(
        "alignment and variance lower the ATE",
        "ablation, Replica: 0.33 → 0.26 cm",
        "less",
        in_claims("cgslam", ATE, "full", "without both"),
    ),
    Claim("… alignment alone", "0.28 → 0.26 cm", "less", in_claims("cgslam", ATE, "full", "without alignment")),
    Claim("… variance alone", "0.30 → 0.26 cm", "less", in_claims("cgslam", ATE, "full", "without variance")),
    Claim(
        "isotropy lowers the ATE and prevents failure",
        "Replica: office3 0.72 → 0.31 cm; office4 fails without it",
        "less",
        in_claims("cgslam", ATE, "full", "without isotropy"),
    ),
    Claim(
        "pruning by the uncertainty of primitives lowers the ATE",
        "a curve for room1, no number",
        "less",
        in_claims("cgslam", ATE, "full", "without fading"),
    ),
    Claim(
        "the same in `sigma`: better depth",
        NO_NUMBER,
        "less",
        in_weights("path", DEPTH, "default", "pruning: no fading"),
    ),
    Claim(
        "U in the loss of `sigma` lowers the ATE",
        NO_NUMBER,
        "less",
        in_weights("path", ATE, "default", "mapping: no U"),
    ),
    Claim(
        "tracking by pixels or splats of low U lowers the ATE",
        "overview, no number",
        "less",
        in_weights("path", ATE, "tracking: depth by U", "default"),
        "ours: depth weighted by U, against V",
    ),
    Claim(
        "the complete pose gradient is more accurate than the released code's",
        "§ on the pose: no number",
        "less",
        in_claims("cgslam", ATE, "full", "simplified gradient"),
        "without the path through the 2D covariance",
    ),
    Claim(
        "an axis-angle is better than a quaternion",
        "stated, no number",
        "less",
        in_claims("cgslam", ATE, "full", "quaternion"),
    ),
    Claim(
        "bundle adjustment of all poses of the window lowers the ATE",
        "eq. 21; the code moves the newest pose only",
        "less",
        in_claims("cgslam", ATE, "full", "newest pose only"),
    ),
    Claim(
        "the light form needs less time",
        "runtime, office0: 8.5 → 15.4 frames/s",
        "less",
        in_claims("cgslam", CPU, "full", "double width"),
        "160 against 320 pixels of width",
    ),
    Claim(
        "… and a smaller map", "231.66 → 56.50 MB", "less", in_claims("cgslam", SPLATS, "full", "double width")
    ),
    Claim(
        "… and its ATE is higher",
        "Replica: 0.27 → 0.42 cm",
        "more",
        in_claims("cgslam", ATE, "full", "double width"),
    ),
    Claim(
        "few splats suffice: `cgslam-fast` has fewer than `varsplat-fast`",
        NO_NUMBER,
        "less",
        in_systems(SPLATS, "cgslam-fast", "varsplat-fast"),
    ),
    Claim(
        "NetVLAD chooses the window faster than overlap",
        "stated, no number",
        "less",
        None,
        "its weights are a download with their own licence",
    ),
    Claim(
        "ATE on Replica, TUM, ScanNet",
        "0.27, 4.0, 8.08 cm",
        "less",
        None,
        NO_DATA.format("cgslam-replica"),
    ),
    Claim(
        "views and surface on Replica",
        "PSNR 37.17 dB, SSIM 0.987, LPIPS 0.060; accuracy 1.01, completion 2.84 cm",
        "more",
        None,
        NO_DATA.format("cgslam-replica"),
    ),
)  # fmt: skip
PAPERS = {"VarSplat": VARSPLAT, "CG-SLAM": CGSLAM}


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

    *reproduced*: as claimed on more than half of the sequences; otherwise *not reproduced*.
    """
    if claim.evidence is None:
        return "not measurable here"
    if not found:
        return "not measured yet"
    held, opposite = agreement(claim, found)
    if 2 * held > len(found):
        return "**reproduced**"
    return "**not reproduced: the opposite**" if 2 * opposite > len(found) else "**not reproduced**"


def counted(claim: Claim, found: Sequence[PairedDifference]) -> str:
    """Count the sequences as claimed, the opposite, and within one deviation."""
    held, opposite = agreement(claim, found)
    if claim.claimed == "no worse":
        return f"not worse on {held} of {len(found)}"
    parts = [f"as claimed on {held} of {len(found)}"]
    parts += [f"the opposite on {opposite}"] if opposite else []
    within = len(found) - held - opposite
    return ", ".join([*parts, *([f"within one deviation on {within}"] if within else [])])


def row(claim: Claim, folder: Path) -> list[str]:
    """Return the row of a claim. Raises KeyError if its results are missing."""
    evidence = claim.evidence
    if evidence is None:
        return [claim.said, claim.published, f"– ({claim.remark})", verdict(claim, []), "–"]
    measured = record.latest(evidence.results, folder)
    if measured is None:
        raise KeyError(f"the table of claims needs the results {evidence.results!r}")
    found = differences(evidence, measured)
    program = f"[{evidence.results}](benchmarks.md#{evidence.results})"
    if not found:
        return [claim.said, claim.published, "–", verdict(claim, []), program]
    cells = [f"{source} {_written(difference)}" for source, difference in found.items()]
    title = evidence.figure.title + (f", {evidence.figure.unit}" if evidence.figure.unit else "")
    what = f"{evidence.changed} − {evidence.against}" if evidence.against else evidence.changed
    text = f"{title}, *{what}*: {'; '.join(cells)}" + (f" ({claim.remark})" if claim.remark else "")
    judged = f"{verdict(claim, [*found.values()])}: {counted(claim, [*found.values()])}"
    return [claim.said, claim.published, text, judged, f"{program}, {seeds(evidence, measured)}"]


def seeds(evidence: Evidence, measured: dict[str, Any]) -> str:
    """Return the number of seeds and the commit of the results."""
    count = len({run["seed"] for run in evidence.read(measured)})
    return f"{count} seeds, {(measured['commit'] or 'no commit')[:9]}"


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
    return "\n" + "\n".join(made) + "\n"


# ---- the results of claims.py alone ----


VALUES: dict[str, tuple[Figure, ...]] = {
    "varsplat": (ATE, PSNR, DEPTH, RANK, CPU),
    "cgslam": (ATE, CHAMFER, Figure("floaters", "floaters", "%", -1, 100.0), PSNR, DEPTH, SPLATS, CPU),
    "hops": (Figure("rank", "Spearman of added uncertainty and error", "", +1, digits=2),),
    "registration": (
        Figure("registration_m", "error", "cm", -1, 100.0),
        Figure("registration_deg", "error of rotation", "°", -1),
        Figure("accepted", "accepted", "", +1, digits=1),
        Figure("pairs", "pairs", "", 0, digits=1),
    ),
    "localisation": (
        Figure("localised_m", "error", "cm", -1, 100.0, digits=3),
        Figure("steps", "steps", "", -1, digits=1),
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


def by_chance() -> str:
    """Return how often a change without effect exceeds one deviation with the least number of seeds."""
    return f"{passed_by_chance(LEAST_SEEDS):.0%}"
