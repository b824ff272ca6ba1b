"""Compare runs that differ in one setting, at equal seeds: mean and spread of the differences, and a verdict.

There is one test, `judge`: does the 95 % t interval of a mean exclude 0? Its values are the differences at equal seeds,
for a verdict on one sequence, or the mean differences of several sequences, for one over them (`over_sequences`).
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

from scipy.stats import t as student

from sigmasplat.run.figures import number

Run = Mapping[str, Any]
"""A run as the file of an ablation stores it: `variant`, `seed`, and `figures` by name, None for a missing value."""
Verdict = Literal["helps", "harms", "no clear effect", "not tested"]
CHANCE = 0.05
"""How often a change without any effect is called one, at most."""
RATIO_UNITS = ("cm", "mm", "°", "k", "ms")
"""Units of figures that are compared in percent over sequences: a centimetre is much on one and little on another."""


@dataclass(frozen=True)
class Figure:
    """A figure of a run and how it is shown: value × factor in `unit`.

    `better` is +1 if larger is better, −1 if smaller is better, and 0 if neither is.
    """

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
"""PSNR and depth L1 are of held-out views. PSNR is given before and after the refinement of the final map. Figures of
quality are judged; counts and speed are not."""


def figures_of(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Return a run's figures, taken from its metrics; None for a missing one."""
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
    """List the figures to show; if no final map was refined, there is one PSNR instead of two."""
    if any(run["figures"].get(BEFORE) is not None for run in runs):
        return list(FIGURES)
    return [replace(f, title="PSNR") if f.name == AFTER else f for f in FIGURES if f.name != BEFORE]


def by_seed(runs: Sequence[Run], variant: str, figure: Figure) -> dict[int, float]:
    """Return a figure of a variant's runs in its unit, by seed; runs without it are left out."""
    found = {run["seed"]: run["figures"].get(figure.name) for run in runs if run["variant"] == variant}
    return {seed: figure.factor * value for seed, value in found.items() if value is not None}


def deviation(values: Sequence[float]) -> float | None:
    """Return the sample standard deviation, None for fewer than two values."""
    return statistics.stdev(values) if len(values) > 1 else None


def spread(values: Sequence[float], digits: int) -> str:
    """Format mean ± standard deviation; a whole number that never varies as it is, a dash without values."""
    if not values:
        return "–"
    mean, std = statistics.fmean(values), deviation(values)
    if mean.is_integer() and not std:
        return number(mean, 0)
    return number(mean, digits) + ("" if std is None else f" ± {number(std, digits)}")


def best(means: Mapping[str, float], figure: Figure) -> set[str]:
    """Return the variants with the best printed mean; empty if all are equal or the figure has no better direction."""
    printed = {variant: round(mean, figure.digits) for variant, mean in means.items()}
    if not figure.better or len(set(printed.values())) < 2:
        return set()
    top = max(figure.better * value for value in printed.values())
    return {variant for variant, value in printed.items() if figure.better * value == top}


def rows(
    runs: Sequence[Run], variants: Sequence[str], mark: Callable[[str], str], figures: Sequence[Figure]
) -> list[list[str]]:
    """Return a row per variant: its name and each figure's mean ± standard deviation; `mark` is put at the best
    value."""
    laid_out = [[variant] for variant in variants]
    for figure in figures:
        values = {variant: list(by_seed(runs, variant, figure).values()) for variant in variants}
        top = best({variant: statistics.fmean(v) for variant, v in values.items() if v}, figure)
        for row, (variant, found) in zip(laid_out, values.items(), strict=True):
            text = spread(found, figure.digits)
            row.append(mark(text) if variant in top else text)
    return laid_out


@cache
def t_limit(count: int, chance: float) -> float:
    """Return the |t| that a mean of `count` normal values without effect exceeds with this probability."""
    return float(student.ppf(1 - chance / 2, count - 1))


def interval(values: Sequence[float], chance: float = CHANCE) -> tuple[float, float] | None:
    """Return the t interval of the mean, which misses the true mean with probability `chance`; None for one value."""
    if len(values) < 2:
        return None
    mean, error = statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(values))
    half = t_limit(len(values), chance) * error
    return mean - half, mean + half


def judge(values: Sequence[float], better: int, chance: float = CHANCE) -> Verdict:
    """Return whether differences show an effect: whether the interval of their mean excludes 0. better: +1 or −1."""
    found = interval(values, chance)
    if found is None:
        return "not tested"
    low, high = sorted(better * end for end in found)
    return "helps" if low > 0 else "harms" if high < 0 else "no clear effect"


@dataclass(frozen=True)
class PairedDifference:
    """How a change affects a figure: its differences, in its unit, at each seed that both have, or of each sequence.

    Runs with the same seed see the same scene and random numbers, so what these contribute cancels in the difference.
    level: mean of the figure without the change.
    """

    figure: Figure
    each: tuple[float, ...]
    level: float | None = None

    @property
    def mean(self) -> float:
        """Return the mean difference."""
        return statistics.fmean(self.each)

    @property
    def deviation(self) -> float | None:
        """Return the sample standard deviation of the differences, None for a single one."""
        return deviation(self.each)

    @property
    def unchanged(self) -> bool:
        """Return whether the figure is the same in every run."""
        return not any(self.each)

    @property
    def verdict(self) -> Verdict:
        """Judge the differences; none is clear that its figure's digits do not show."""
        return self.judged()

    def judged(self, chance: float = CHANCE) -> Verdict:
        """Judge the differences at another probability of being called an effect by chance."""
        found = judge(self.each, self.figure.better, chance)
        hidden = round(self.mean, self.figure.digits) == 0
        return "no clear effect" if found in ("helps", "harms") and hidden else found

    @property
    def stands_out(self) -> bool:
        """Return whether the differences show an effect."""
        return self.verdict in ("helps", "harms")

    def written(self) -> str:
        """Format the difference with its sign, ± standard deviation and unit; only 0 if nothing changed."""
        if self.unchanged:
            return "0"
        sign = "+" if self.mean > 0 else ""
        std = "" if self.deviation is None else f" ± {number(self.deviation, self.figure.digits)}"
        return f"{sign}{number(self.mean, self.figure.digits)}{std} {self.figure.unit}".rstrip()


def difference(runs: Sequence[Run], changed: str, against: str, figure: Figure) -> PairedDifference | None:
    """Return how one variant differs from another in a figure, over the seeds that both have; None without any."""
    base, other = by_seed(runs, against, figure), by_seed(runs, changed, figure)
    seeds = [seed for seed in base if seed in other]
    if not seeds:
        return None
    level = statistics.fmean(base[seed] for seed in seeds)
    return PairedDifference(figure, tuple(other[seed] - base[seed] for seed in seeds), level)


def paired_differences(runs: Sequence[Run], changed: str, against: str) -> list[PairedDifference]:
    """Return how one variant differs from another in each judged figure, over the seeds that both have."""
    judged = (figure for figure in columns(runs) if figure.judged)
    return [found for figure in judged if (found := difference(runs, changed, against, figure)) is not None]


def over_sequences(found: Sequence[PairedDifference]) -> PairedDifference:
    """Return the mean differences of several sequences as one: each counts once, whatever its number of seeds.

    A sequence may have its own noise, and an effect of its own that more seeds do not remove; then the t test of the
    sequences' means is right, that of all seeds is not (Ibragimov and Müller 2010). Lengths, angles, times and numbers
    of splats are compared in percent of the value without the change.
    """
    figure, levels = found[0].figure, [difference.level for difference in found]
    if figure.unit not in RATIO_UNITS or not all(levels):
        return PairedDifference(figure, tuple(difference.mean for difference in found))
    each = tuple(100 * difference.mean / level for difference, level in zip(found, levels, strict=True) if level)
    return PairedDifference(replace(figure, unit="%", digits=1), each)


def described(found: Sequence[PairedDifference]) -> str:
    """Describe in words how a change affects the figures."""
    if not found:
        return "nothing to compare"
    if all(difference.unchanged for difference in found):
        return "no figure differs in any run"
    if any(difference.deviation is None for difference in found):
        return "one seed is not enough to judge"
    parts = []
    for verdict in ("helps", "harms"):
        named = [f"{e.figure.title} ({e.written()})" for e in found if e.verdict == verdict]
        parts += [f"{verdict} {joined(named)}"] if named else []
    rest = [e.figure.title for e in found if e.verdict == "no clear effect"]
    if rest:
        where = f" on {joined(rest)}" if parts else ""
        parts.append(f"no clear effect{where}")
    return "; ".join(parts)


def joined(words: Sequence[str]) -> str:
    """Join words as in: a, b and c."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))
