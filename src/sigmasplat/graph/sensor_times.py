"""Measure when the sensor reads depth and rows, from pairs of keyframes that see the same.

A pair of images agrees best at the true times: late depth contradicts colour where the camera changes its speed, and
rows that are read one after another bend an image where it moves. The cost of aligning a pair, as a function of the
three times, is its lowest cost over all motions (a profile). The sum over the pairs is minimised by Newton steps; the
covariance is that of an M-estimator whose terms share images (sandwich, as in `fit.align`). No truth is used.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.stats import f as f_distribution

from sigmasplat.data.readout import UNKNOWN_TIMES, Readout, SensorTimes
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.types import Matrix, Task

FIRST_MEASURED, MOST_MEASURED = 60, 60
"""Alignments before the first measurement, and pairs of one."""
STEP_S, LONGEST_S = 0.01, 0.03
"""Step of the differences, where images move by some pixels; and the longest Newton step, the time of one frame."""
ROUNDS, NO_STEP_S = 10, 1e-4
"""Most rounds; smaller steps move no point by a tenth of a millimetre."""
NEIGHBOURS = 3
"""So many keyframes in a row see the same: the errors of their pairs are not independent."""
BIAS_S = 1e-4
"""Systematic error of a time: in so long, an image moves by `fit.align.BIAS_PX` at 100 pixels per second."""
LEAST_PAIRS, LEAST_GROUPS = 10, 5
LEAST_OVERLAP = 0.25
LEVEL, HOPELESS = 0.999, 0.9
"""Times are used if the hypothesis that all rows are read at once is rejected at the first level; if the first step is
not even sure at the second one, it was the last."""


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

    def at(self, times_s: Matrix) -> "Pair | None":
        """Return the pair with its motion if the sensor has these times [3], and the cost per pixel there; None if its
        images overlap too little."""
        times = _times(times_s, np.zeros(3))
        images = self.reference.read(times.read(self.of_reference)), self.live.read(times.read(self.of_live))
        found = align(*images, self.T_live_reference, 12, update_stop=5e-5)
        if found.degenerate or found.overlap < LEAST_OVERLAP or not found.cost > 0.0:
            return None
        return self._replace(T_live_reference=found.T_live_reference, cost=found.cost)


def measured(pairs: Sequence[Pair]) -> Task[SensorTimes]:
    """Measure the times, in slices of one pair and round.

    Returns all zero, without standard deviations, if the images do not show that anything is read late. The images of a
    pair may be small: half of the working size takes a quarter of the time and gives the same times.
    """
    times, sure = yield from estimated(pairs)
    return times if sure else UNKNOWN_TIMES


def estimated(pairs: Sequence[Pair]) -> Task[tuple[SensorTimes, bool]]:
    """Return where the pairs agree best, and whether it is sure that anything is read late; times are unknown if it is
    neither sure nor refuted. In slices as `measured`."""
    moved, times_s, longest_s = list(pairs), np.zeros(3), LONGEST_S
    lowest, near = np.inf, False
    for _ in range(ROUNDS):
        there = list[Pair]()
        for pair in moved:
            found = pair.at(times_s)
            yield
            there += [] if found is None else [found]
        if len(there) < LEAST_PAIRS:
            return UNKNOWN_TIMES, False
        cost = float(np.mean([np.log(pair.cost) for pair in there]))
        if near or cost < lowest:
            moved, terms = there, list[Term]()
            for pair in moved:
                terms += [_expanded(pair, times_s)]
                yield
            if not any(term.bend.any() for term in terms):  # no camera moved
                return UNKNOWN_TIMES, False
            lowest, best_s, (step_s, covariance) = cost, times_s, newton_step(terms)
            covariance += BIAS_S**2 * np.eye(3)
            std_s, groups = np.sqrt(np.diag(covariance)), len({term.number // NEIGHBOURS for term in terms})
            near = bool((np.abs(step_s) <= 2.0 * std_s).all() and std_s.max() < STEP_S)  # costs hardly differ
            still = bool((np.abs(step_s) <= np.maximum(0.5 * std_s, NO_STEP_S)).all())
            if std_s.max() < STEP_S and (still or not _sure(best_s + step_s, covariance, groups, HOPELESS)):
                break
        else:
            longest_s = float(np.abs(times_s - best_s).max()) / 3.0
        times_s = best_s + step_s * min(1.0, longest_s / float(np.abs(step_s).max()))
    settled = std_s.max() < STEP_S and bool((np.abs(step_s) <= np.maximum(std_s, NO_STEP_S)).all())
    best_s, exact = best_s + step_s, std_s.max() < STEP_S / 2 and groups >= LEAST_GROUPS
    sure = settled and _sure(best_s, covariance, groups)
    at_once = exact and not _sure(best_s, covariance, groups, HOPELESS)
    return _times(best_s, std_s) if sure or at_once else UNKNOWN_TIMES, sure


def _sure(times_s: Matrix, covariance: Matrix, groups: int, level: float = LEVEL) -> bool:
    """Return whether times are not 0, by Hotelling's test; covariance: of `newton_step`, from so many groups."""
    if groups < LEAST_GROUPS:
        return False
    limit = 3.0 * (groups - 1) / groups * float(f_distribution.ppf(level, 3, groups - 3))
    return bool(times_s @ np.linalg.solve(covariance, times_s) > limit)


def _times(values_s: Matrix, std_s: Matrix) -> SensorTimes:
    late, depth_rows, color_rows = values_s.tolist()
    a, b, c = std_s.tolist()
    return SensorTimes(late, depth_rows, color_rows, (a, b, c))


class Term(NamedTuple):
    """Slope [3] and bend [3, 3] of the cost of a pair at some times, as shares of the cost, and its number."""

    slope: Matrix
    bend: Matrix
    number: int


def _expanded(pair: Pair, times_s: Matrix) -> Term:
    """Return the term of a pair at some times."""

    def cost(of_s: Matrix) -> float:
        return (pair.at(of_s) or pair).cost

    pair = pair.at(times_s) or pair  # once more: the others begin there
    units = STEP_S * np.eye(3)
    above, below = (np.array([cost(times_s + sign * unit) for unit in units]) for sign in (1.0, -1.0))
    bend = np.diag(above + below - 2.0 * pair.cost)
    for i, j in combinations(range(3), 2):
        bend[i, j] = bend[j, i] = cost(times_s + units[i] + units[j]) - above[i] - above[j] + pair.cost
    return Term((above - below) / (2.0 * STEP_S * pair.cost), bend / (STEP_S**2 * pair.cost), pair.number)


def newton_step(terms: Sequence[Term]) -> tuple[Matrix, Matrix]:
    """Return the step [3] to the lowest point of the sum of terms, and the covariance [3, 3] there.

    Terms of keyframes in a row share errors; three numbers are fitted to so many groups of them. Directions in which
    the sum is not convex, far from its lowest point, take the step of one that is as much bent the other way.
    """
    slope, bend = np.array([term.slope for term in terms]), np.array([term.bend for term in terms])
    values, vectors = np.linalg.eigh(bend.sum(0))
    sizes = np.maximum(np.abs(values), 1e-2 * np.abs(values).max())
    inverse = vectors @ np.diag(1.0 / sizes) @ vectors.T
    step = -inverse @ slope.sum(0)
    left, groups = slope + bend @ step, np.array([term.number // NEIGHBOURS for term in terms])
    of_groups = np.array([left[groups == group].sum(0) for group in np.unique(groups)])
    n = len(of_groups)
    return np.asarray(step), np.asarray(inverse @ (of_groups.T @ of_groups) @ inverse) * n / max(n - 3, 1)
