"""Read what other benchmarks have measured as evidence on a claim: runs by sequence, variant and seed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from paired_comparison import Figure

Runs = list[dict[str, Any]]
"""Runs, each with `source`, `variant`, `seed` and `figures`."""
Claimed = Literal["less", "more", "no worse"]


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


def of_scenes(measured: dict[str, Any]) -> Runs:
    """Read consistency.py: its scenes with their seeds as one sequence, whose differences are pooled."""
    jobs = [result for result in measured["figures"]["jobs"] if result["problem"] is None]
    scenes = list(dict.fromkeys(result["job"]["source"] for result in jobs))
    return [
        {
            "source": f"{len(scenes)} scenes",
            "variant": result["variant"],
            "seed": scenes.index(result["job"]["source"]) + len(scenes) * result["job"]["seed"],
            "figures": result["figures"],
        }
        for result in jobs
    ]


def of_ways(measured: dict[str, Any]) -> Runs:
    """Read the sequences of pose_gradient.py as one, whose differences are pooled; a variant is a list of paths."""
    runs = [run for run in measured["figures"]["sequence"] if run["problem"] is None]
    sources = list(dict.fromkeys(run["source"] for run in runs))
    return [
        {
            "source": f"{len(sources)} sequences",
            "variant": run["way"],
            "seed": sources.index(run["source"]) + len(sources) * run["seed"],
            "figures": run["figures"],
        }
        for run in runs
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

    Without `against`, the figure itself is compared with 0. repeats: what the runs of a sequence differ in.
    """

    results: str
    read: Callable[[dict[str, Any]], Runs]
    figure: Figure
    changed: str
    against: str | None = None
    repeats: str = "seeds"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper: what it says, what it publishes and where, the sign that it claims for the measured
    difference, and the evidence; without evidence, `remark` says why it cannot be measured here."""

    said: str
    published: str
    claimed: Claimed
    evidence: Evidence | None
    remark: str = ""
