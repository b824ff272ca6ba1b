"""Read what other benchmarks have measured as evidence on a claim: runs by sequence, variant and seed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from paired_comparison import Figure

Runs = list[dict[str, Any]]
"""Runs, each with `source`, `variant`, `seed` and `figures`."""
Claimed = Literal["less", "more", "no worse"]


def of_rows(*groups: str) -> Callable[[dict[str, Any]], Runs]:
    """Return what reads the rows of the first of these groups that was measured by claims.py or weights.py."""

    def read(measured: dict[str, Any]) -> Runs:
        by = {group: [run for run in measured["figures"]["runs"] if run["group"] == group] for group in groups}
        return next((runs for runs in by.values() if runs), [])

    return read


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


def of_scenes(measured: dict[str, Any]) -> Runs:
    """Read the jobs of consistency.py, whose variants leave out a part of the method."""
    return [
        {"source": result["job"]["source"], "seed": result["job"]["seed"]}
        | {"variant": result["variant"], "figures": result["figures"]}
        for result in measured["figures"]["jobs"]
        if result["problem"] is None
    ]


def of_ways(measured: dict[str, Any]) -> Runs:
    """Read the sequences of pose_gradient.py; a variant is a list of paths of the gradient."""
    return [run | {"variant": run["way"]} for run in measured["figures"]["sequence"] if run["problem"] is None]


def of_scores(quantity: str, pixels: str) -> Callable[[dict[str, Any]], Runs]:
    """Return what reads uncertainty.py: scores of held-back views of final maps; a variant is a predictor.

    The synthetic rooms with steady exposure are the synthetic rooms again, not another sequence.
    """

    def read(measured: dict[str, Any]) -> Runs:
        return [
            {"source": run["source"], "variant": name, "seed": run["seed"], "figures": scores}
            for run in measured["figures"]["runs"]
            if run["source"] != "synthetic, steady exposure"
            for name, scores in run["scores"][quantity]["final"]["held back"][pixels]["predictors"].items()
        ]

    return read


def of_loops(measured: dict[str, Any]) -> Runs:
    """Read the drift experiment of loops.py: the path of each run with its loops, and without them."""
    return [
        {"source": job["source"], "variant": variant, "seed": job["seed"], "figures": {"ate_m": job["figures"][name]}}
        for job in measured["figures"]["jobs"]
        if job["problem"] is None and job["experiment"] == "drift"
        for variant, name in (("loops", "ate_m"), ("no loops", "ate_odometry_m"))
    ]


@dataclass(frozen=True)
class Evidence:
    """Where a figure is measured: results by name, what reads them, and the variants to compare.

    Without `against`, the figure itself is compared with 0. preset: that of the runs, in other settings than the
    paper's; own: the group of claims.py that has the paper's own iterations and rates, if there is one.
    """

    results: str
    read: Callable[[dict[str, Any]], Runs]
    figure: Figure
    changed: str
    against: str | None = None
    preset: str = ""
    own: str = ""

    def family(self, measured: dict[str, Any]) -> str:
        """Return the family of the settings that the runs were made with."""
        runs = self.read(measured)
        owned = self.own and runs and runs[0].get("group") == self.own
        return "the paper's own" if owned else f"other: `{self.preset}`"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper: what it says, what it publishes and where, the sign that it claims for the measured
    difference, and the evidence; without evidence, `remark` says why it cannot be measured here."""

    said: str
    published: str
    claimed: Claimed
    evidence: Evidence | None
    remark: str = ""
