"""Fit numbers that describe a sensor to pairs of keyframes that see the same.

A pair of images agrees best at the true numbers. The cost of aligning a pair, as a function of them, is its lowest cost
over all motions (a profile). The sum over the pairs is minimised by Newton steps; the covariance is that of an
M-estimator whose terms share images (sandwich, as in `fit.align`). No truth is used.

When the sensor reads depth and rows is found so: late depth contradicts colour where the camera changes its speed, and
rows that are read one after another bend an image where it moves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from sigmasplat.data.readout import UNKNOWN_TIMES, Readout, SensorTimes
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.types import Matrix, Task

LONGEST = 3.0
"""The longest Newton step, in units of the parameters."""
ROUNDS, NO_STEP = 10, 0.01
"""Most rounds; smaller steps, in units, move no point by a tenth of a millimetre; also the least spread of a fit."""
NEIGHBOURS = 3
"""So many keyframes in a row see the same: the errors of their pairs are not independent."""
BIAS = 0.1
"""Systematic error of a parameter, in units. Slopes and bends of costs are differences over a whole unit, where a cost
is not quite a parabola: late depth is found 1 to 2 ms too near to 0. Differences over less than half a unit are several
times as noisy."""
LEAST_PAIRS, LEAST_GROUPS, LEAST_OVERLAP = 10, 5, 0.25
"""A fit needs so many pairs, and a test so many groups of them; images of a pair share so much."""
LEVEL, HOPELESS = 0.999, 0.9
"""Values are used if the hypothesis that all are 0 is rejected at the first level; if the first step is not even sure
at the second one, it was the last."""


@dataclass(frozen=True)
class Parameters:
    """What is fitted. units [n]: a change of a parameter by its unit moves images by some pixels; images: of a pair at
    some values [n]."""

    units: Matrix
    images: Callable[["Pair", Matrix], tuple[Pyramid, Pyramid]]


class Pair(NamedTuple):
    """Two images that see the same, how their cameras moved, the motion between them, and the number of the later one:
    pairs of later images in a row share errors."""

    reference: Pyramid
    live: Pyramid
    of_reference: Readout
    of_live: Readout
    T_live_reference: Matrix
    number: int
    cost: float = 0.0

    def at(self, values: Matrix, parameters: Parameters) -> "Pair | None":
        """Return the pair with its motion at some values [n], and the cost per pixel there; None if its images overlap
        too little."""
        found = align(*parameters.images(self, values), self.T_live_reference)
        if found.degenerate or found.overlap < LEAST_OVERLAP or not found.cost > 0.0:
            return None
        return self._replace(T_live_reference=found.T_live_reference, cost=found.cost)


class Fit(NamedTuple):
    """Values [n] where pairs agree best, and their standard deviations, None if they are neither sure nor refuted."""

    values: Matrix
    std: Matrix | None = None
    sure: bool = False  # whether any value is surely not 0


def fitted(pairs: Sequence[Pair], parameters: Parameters) -> Task[Fit]:
    """Find where the pairs agree best, in slices of one pair and round."""
    count, units = len(parameters.units), parameters.units
    moved, x, longest, unknown = list(pairs), np.zeros(count), LONGEST, Fit(np.zeros(count))
    lowest, near = np.inf, False
    for _ in range(ROUNDS):
        there = list[Pair]()
        for pair in moved:
            found = pair.at(x * units, parameters)
            yield
            there += [] if found is None else [found]
        if len(there) < LEAST_PAIRS:
            return unknown
        cost = float(np.mean([np.log(pair.cost) for pair in there]))
        if near or cost < lowest:
            moved, terms = there, list[Term]()
            for pair in moved:
                terms += [_expanded(pair, x, parameters)]
                yield
            if not any(term.bend.any() for term in terms):  # no camera moved
                return unknown
            lowest, best, (step, covariance) = cost, x, newton_step(terms)
            covariance += NO_STEP**2 * np.eye(count)
            std, groups = np.sqrt(np.diag(covariance)), len({term.number // NEIGHBOURS for term in terms})
            near = bool((np.abs(step) <= 2.0 * std).all() and std.max() < 1.0)  # costs hardly differ
            still = bool((np.abs(step) <= np.maximum(0.5 * std, NO_STEP)).all())
            if std.max() < 1.0 and (still or not _is_sure(best + step, covariance, groups, HOPELESS)):
                break
        else:
            longest = float(np.abs(x - best).max()) / 3.0
        x = best + step * min(1.0, longest / float(np.abs(step).max()))
    settled = std.max() < 1.0 and bool((np.abs(step) <= np.maximum(std, NO_STEP)).all())
    best, exact = best + step, std.max() < 0.5 and groups >= LEAST_GROUPS
    sure = settled and _is_sure(best, covariance, groups)
    none = exact and not _is_sure(best, covariance, groups, HOPELESS)
    return Fit(best * units, np.hypot(std, BIAS) * units, sure) if sure or none else unknown


def _is_sure(x: Matrix, covariance: Matrix, groups: int, level: float = LEVEL) -> bool:
    """Return whether values [n] are not 0, by Hotelling's test; covariance: of `newton_step`, from so many groups."""
    n = len(x)
    if groups < max(LEAST_GROUPS, n + 2):
        return False
    limit = n * (groups - 1) / groups * float(fdtri(n, groups - n, level))
    return bool(x @ np.linalg.solve(covariance, x) > limit)


class Term(NamedTuple):
    """Slope [n] and bend [n, n] of the cost of a pair at some values, as shares of the cost, and its number."""

    slope: Matrix
    bend: Matrix
    number: int


def _expanded(pair: Pair, x: Matrix, parameters: Parameters) -> Term:
    """Return the term of a pair at some values [n], in units."""

    def cost(x: Matrix) -> float:
        return (pair.at(x * parameters.units, parameters) or pair).cost

    pair = pair.at(x * parameters.units, parameters) or pair  # once more: the others begin there
    one = np.eye(len(x))
    above, below = (np.array([cost(x + sign * step) for step in one]) for sign in (1.0, -1.0))
    bend = np.diag(above + below - 2.0 * pair.cost)
    for i, j in combinations(range(len(x)), 2):
        bend[i, j] = bend[j, i] = cost(x + one[i] + one[j]) - above[i] - above[j] + pair.cost
    return Term((above - below) / (2.0 * pair.cost), bend / pair.cost, pair.number)


def newton_step(terms: Sequence[Term]) -> tuple[Matrix, Matrix]:
    """Return the step [n] to the lowest point of the sum of terms, and the covariance [n, n] there.

    Terms of keyframes in a row share errors; n numbers are fitted to so many groups of them. Directions in which the
    sum is not convex, far from its lowest point, take the step of one that is as much bent the other way.
    """
    slope, bend = np.array([term.slope for term in terms]), np.array([term.bend for term in terms])
    values, vectors = np.linalg.eigh(bend.sum(0))
    sizes = np.maximum(np.abs(values), 1e-2 * np.abs(values).max())
    inverse = vectors @ np.diag(1.0 / sizes) @ vectors.T
    step = -inverse @ slope.sum(0)
    left, groups = slope + bend @ step, np.array([term.number // NEIGHBOURS for term in terms])
    of_groups = np.array([left[groups == group].sum(0) for group in np.unique(groups)])
    n = len(of_groups)
    return np.asarray(step), np.asarray(inverse @ (of_groups.T @ of_groups) @ inverse) * n / max(n - len(step), 1)


# ---- the times of the sensor ----

MEASURED = 60
"""The most pairs of a measurement; the first is made when there are so many alignments."""


def read(pair: Pair, times: SensorTimes) -> tuple[Pyramid, Pyramid]:
    """Return the images of a pair as a sensor with these times has read them."""
    return pair.reference.read(times.read(pair.of_reference)), pair.live.read(times.read(pair.of_live))


TIMES = Parameters(np.full(3, 0.01), lambda pair, s: read(pair, SensorTimes(*s.tolist(), std_s=(0.0, 0.0, 0.0))))
"""Depth after colour, read-out of depth, and of colour, s. In 10 ms, images of a hand-held camera move by some pixels;
the longest step is the time of one frame."""


def measured(pairs: Sequence[Pair]) -> Task[SensorTimes]:
    """Measure the times, in slices of one pair and round.

    Returns all zero, without standard deviations, if the images do not show that anything is read late. The images of a
    pair may be small: half of the working size takes a quarter of the time and gives the same times.
    """
    fit = yield from fitted(pairs, TIMES)
    return times_of(fit) if fit.sure else UNKNOWN_TIMES


def times_of(fit: Fit) -> SensorTimes:
    """Return the times where the pairs agree best; unknown if they are neither sure nor refuted."""
    return UNKNOWN_TIMES if fit.std is None else SensorTimes(*fit.values.tolist(), std_s=tuple(fit.std.tolist()))
