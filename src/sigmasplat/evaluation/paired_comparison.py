"""Compare runs that differ by one switch: mean and spread over seeds, and which effects stand out of the spread."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from scipy.stats import t as student

from sigmasplat.report.tables import number

Run = Mapping[str, Any]
"""A run as the file of an ablation holds it: `variant`, `seed`, and `figures` by name, None where there is none."""
Verdict = Literal["helps", "harms", "within the spread", "unknown"]


@dataclass(frozen=True)
class Figure:
    """A number of a run and how it is shown: value × factor in its unit; `better` is +1 or −1, 0 where neither is."""

    name: str
    title: str
    unit: str
    better: int
    factor: float = 1.0
    digits: int = 2
    judged: bool = True

    @property
    def head(self) -> str:
        """Return title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


BEFORE, AFTER = "psnr_before_db", "psnr_db"
FIGURES = (
    Figure("ate_m", "ATE", "cm", -1, 100.0),
    Figure(BEFORE, "PSNR before", "dB", +1),
    Figure(AFTER, "PSNR after", "dB", +1),
    Figure("depth_l1_m", "depth L1", "cm", -1, 100.0),
    Figure("loops", "loops", "", 0, digits=1, judged=False),
    Figure("lost", "lost", "", -1, digits=1, judged=False),
    Figure("frames_per_s", "frames/s", "", +1, digits=1, judged=False),
)
"""PSNR and depth are of held-out views, before and after the refinement of the whole map; judged are those of quality,
the others are counts and cost."""


def figures_of(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Pick a run's figures from its metrics; None where there is none."""
    held_out, submaps = metrics.get("held_out") or {}, metrics.get("held_out_submaps") or {}
    return {
        "ate_m": (metrics.get("ate") or {}).get("rmse_m"),
        BEFORE: submaps.get("psnr_db"),
        AFTER: held_out.get("psnr_db"),
        "depth_l1_m": held_out.get("depth_l1_m"),
        "loops": (metrics.get("loops") or {}).get("accepted"),
        "lost": metrics.get("lost"),
        "frames_per_s": metrics.get("frames_per_s"),
    }


def columns(runs: Sequence[Run]) -> list[Figure]:
    """List the figures to show of runs: where no map was refined there is one PSNR, not two."""
    if any(run["figures"][BEFORE] is not None for run in runs):
        return list(FIGURES)
    return [replace(f, title="PSNR") if f.name == AFTER else f for f in FIGURES if f.name != BEFORE]


def by_seed(runs: Sequence[Run], variant: str, figure: Figure) -> dict[int, float]:
    """Collect a figure of a variant's runs in its unit, by seed, leaving out runs that have none."""
    found = {run["seed"]: run["figures"][figure.name] for run in runs if run["variant"] == variant}
    return {seed: figure.factor * value for seed, value in found.items() if value is not None}


def deviation(values: Sequence[float]) -> float | None:
    """Return the sample standard deviation; None of fewer than two."""
    return statistics.stdev(values) if len(values) > 1 else None


def spread(values: Sequence[float], digits: int) -> str:
    """Write mean ± standard deviation; a whole number that never differs as it is, a dash without values."""
    if not values:
        return "–"
    mean, std = statistics.fmean(values), deviation(values)
    if mean.is_integer() and not std:
        return number(mean, 0)
    return number(mean, digits) + ("" if std is None else f" ± {number(std, digits)}")


def best(means: Mapping[str, float], figure: Figure) -> set[str]:
    """Name the variants whose mean is best as printed; none where all are alike or neither way is better."""
    printed = {variant: round(mean, figure.digits) for variant, mean in means.items()}
    if not figure.better or len(set(printed.values())) < 2:
        return set()
    top = max(figure.better * value for value in printed.values())
    return {variant for variant, value in printed.items() if figure.better * value == top}


def rows(
    runs: Sequence[Run], variants: Sequence[str], mark: Callable[[str], str], figures: Sequence[Figure]
) -> list[list[str]]:
    """Lay out a row per variant, its name and each figure's mean ± standard deviation; `mark` marks the best."""
    laid_out = [[variant] for variant in variants]
    for figure in figures:
        values = {variant: list(by_seed(runs, variant, figure).values()) for variant in variants}
        top = best({variant: statistics.fmean(v) for variant, v in values.items() if v}, figure)
        for row, (variant, found) in zip(laid_out, values.items(), strict=True):
            text = spread(found, figure.digits)
            row.append(mark(text) if variant in top else text)
    return laid_out


@dataclass(frozen=True)
class Effect:
    """What a change does to a figure: mean and standard deviation of its differences, seed by seed, in its unit.

    Equal seeds mean equal worlds and equal random numbers, so what they have in common cancels.
    """

    figure: Figure
    mean: float
    deviation: float | None

    @property
    def unchanged(self) -> bool:
        """Return whether the figure is the same in every run."""
        return self.mean == 0 and not self.deviation

    @property
    def verdict(self) -> Verdict:
        """Judge by the mean against one standard deviation; unknown of a single seed."""
        if self.deviation is None:
            return "unknown"
        if abs(self.mean) <= self.deviation:
            return "within the spread"
        return "helps" if self.mean * self.figure.better > 0 else "harms"

    def written(self) -> str:
        """Write the difference with its sign, ± its standard deviation, and the unit; 0 alone where nothing changed."""
        if self.unchanged:
            return "0"
        sign = "+" if self.mean > 0 else ""
        std = "" if self.deviation is None else f" ± {number(self.deviation, self.figure.digits)}"
        return f"{sign}{number(self.mean, self.figure.digits)}{std} {self.figure.unit}".rstrip()


def effects(runs: Sequence[Run], changed: str, against: str) -> list[Effect]:
    """Return what one variant does to each judged figure against another, over the seeds that both have."""
    found = []
    for figure in (figure for figure in columns(runs) if figure.judged):
        base, other = by_seed(runs, against, figure), by_seed(runs, changed, figure)
        differences = [other[seed] - base[seed] for seed in base if seed in other]
        if differences:
            found.append(Effect(figure, statistics.fmean(differences), deviation(differences)))
    return found


def sentence(found: Sequence[Effect]) -> str:
    """Say in words what a change does."""
    if not found:
        return "nothing to compare"
    if all(effect.unchanged for effect in found):
        return "no figure differs in any run"
    if any(effect.deviation is None for effect in found):
        return "one seed has no spread to judge by"
    parts = []
    for verdict in ("helps", "harms"):
        named = [f"{e.figure.title} ({e.written()})" for e in found if e.verdict == verdict]
        parts += [f"{verdict} {listed(named)}"] if named else []
    rest = [e.figure.title for e in found if e.verdict == "within the spread"]
    if rest:
        where = f" on {listed(rest)}" if parts else ""
        parts.append(f"no effect beyond the spread of the seeds{where}")
    return "; ".join(parts)


def listed(words: Sequence[str]) -> str:
    """Join words: a, b and c."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def passed_by_chance(seeds: int) -> float:
    """Return how often a change that does nothing looks as if it did: |mean| > one sample deviation, normal noise."""
    return float(2 * student.sf(math.sqrt(seeds), seeds - 1))
