"""Judge a pose by the probability that it is wrong: accept it, doubt it, or call the camera lost."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit

MEDIAN_NORMAL = 0.6745
"""The median of |x| if x is a standard normal number."""
RECENT, FEW = 50, 5
"""Noise is measured by this many recent frames that were not lost; each of the first few corrects it at once."""
WEIGHTS = {"unexplained": 1.60, "uncorrelated": 2.07, "unsupported": 1.23, "moved": 6.06}
BIAS = 5.31
"""The log odds that a pose is wrong are BIAS + Σ weight · quantity (`evidence`). `benchmarks/judge.py` fits them to
pairs of frames with known truth, aligned from random guesses of which a quarter lead to a wrong pose."""
LOST, DOUBTFUL, SURE = 0.5, 0.1, 0.03
"""Limits of this probability. A tracked pose is lost where it is more likely wrong than right, for a lost frame only
costs itself. Above the second it is doubtful, and tried again from other guesses, which cost little. Below the third, a
pose counts without a path that leads to it: a wrong loop bends the whole map."""
DOUBT = 0.7
"""Without a comparison, a pose is doubtful if its agreement × overlap falls below this share of the usual value."""
FEW_MATCHES = 15
"""A pose from fewer matches, without a known path, must be three times as sure: a dozen features of one wall also match
another wall, and walls are alike."""
FLAT = 0.7
"""Images without texture neither confirm nor refute a pose: as this correlation."""
LEARNS_CORRELATION = 0.9
"""Gray values that correlate as much confirm a pose by themselves."""
MOST_SPREAD_M = 0.05
"""A pose without a known path is refused if the standard deviation of its position is larger: where only a wall is in
view, the images agree as well at every pose along it."""
DIFFERS = 0.02
"""Gray values of a thing may show that it moves if 1 − their correlation is above this."""
DISAGREES = 1.5
"""A thing disagrees with the rest of the image if 1 − correlation is this many times larger with it than without it."""


def evidence(c: Comparison) -> dict[str, float]:
    """Return the quantities by which a pose is judged: logarithms of the share of the surface that is seen through, of
    what the gray values miss to a correlation of 1, and of the share of the images that supports the pose; and how far
    the pose is from its guess. The last is no logarithm: a small distance does not make a pose right."""
    seen, correlation = c.close + c.behind, FLAT if np.isnan(c.correlation) else max(c.correlation, 0.0)
    return {
        "unexplained": math.log(c.behind / max(seen, 1e-9) + 0.01),
        "uncorrelated": math.log(1.02 - correlation),
        "unsupported": -math.log(min(c.common, c.covered) * seen + 0.05),
        "moved": min(c.moved, 1.0),
    }


def p_wrong(c: Comparison) -> float:
    """Return the probability that a pose is wrong: that it shifts the image by more than 5 % of the depth. A pose at
    which the images have next to nothing in common counts as wrong."""
    odds = wrong_odds(c)
    return odds / (1.0 + odds) if math.isfinite(odds) else 1.0


def wrong_odds(c: Comparison) -> float:
    """Return the odds of the same."""
    if not math.isfinite(c.residual):
        return math.inf
    return math.exp(BIAS + sum(WEIGHTS[name] * value for name, value in evidence(c).items()))


def diagnosis(c: Comparison) -> str:
    """Return in words what supports a pose, and what speaks most against it if it is doubtful."""
    supported = f"{min(c.common, c.covered) * (c.close + c.behind):.0%} of the image supports the pose"
    if p_wrong(c) <= DOUBTFUL:
        return supported
    if not math.isfinite(c.residual):
        return "the images have next to nothing in common"
    texture = "the images have no texture" if np.isnan(c.correlation) else f"gray correlates by {c.correlation:.2f}"
    words = {
        "unexplained": f"known surfaces are seen through on {c.behind / max(c.close + c.behind, 1e-9):.0%} of it",
        "uncorrelated": texture,
        "unsupported": "that is little",
        "moved": f"it is off from the expected one by {c.moved:.0%} of the depth",
    }
    best, here = evidence(Comparison(1.0, 1.0, 0.0, 0.0, 0.0, 1.0)), evidence(c)
    return f"{supported}, but {words[max(words, key=lambda name: WEIGHTS[name] * (here[name] - best[name]))]}"


def confirmed(c: Comparison) -> bool:
    """Return whether the images confirm a pose without any knowledge of the camera's path."""
    return p_wrong(c) < SURE


def recognised(c: Comparison, matches: int) -> bool:
    """Return whether the images confirm a pose that this number of features has led to."""
    return p_wrong(c) < (SURE if matches >= FEW_MATCHES else SURE / 3.0)


def differs(c: Comparison) -> bool:
    """Return whether the gray values differ so much that something may have pulled the pose."""
    return 1.0 - c.correlation > DIFFERS


def disagrees(whole: Comparison, without: Comparison | None) -> bool:
    """Return whether something does not agree with the rest, by comparisons with and without it at the same pose."""
    return without is not None and 1.0 - whole.correlation > DISAGREES * (1.0 - without.correlation)


def is_missed(without: Comparison | None, whole: Comparison | None) -> bool:
    """Return whether a thing that was left out belongs to the still scene: the fit is worse without it. The images
    agree less, in depth and in gray, at the pose fitted without the thing than with the thing at the first pose."""
    if without is None or whole is None or without.close >= whole.close:
        return False
    return not 1.0 - without.correlation <= DISAGREES * (1.0 - whole.correlation)


def is_lost(fit: PoseFit, least_agreement: float, least_share: float) -> bool:
    """Return whether tracking failed: the depths of map and sensor disagree, or too few pixels are in common."""
    return fit.agreement < least_agreement or fit.agreement * fit.overlap < least_share


def jumped(value: float, history: Sequence[float], factor: float) -> bool:
    """Return whether a loss exceeds `factor` times the median of the recent losses (VarSplat §3, re-initialisation)."""
    return len(history) >= 5 and value > factor * float(np.median(history[-50:]))


@dataclass(eq=False)
class TrackingStatistics:
    """Values of recent frames that were not lost. residuals: in standard deviations of the law of the sensor, however
    noisy depth is."""

    residuals: list[float] = field(default_factory=list)

    def add(self, c: Comparison) -> None:
        """Add the values of a frame that is not lost."""
        if np.isfinite(c.residual):
            self.residuals.append(c.residual * self.noise)
            del self.residuals[:-RECENT]

    @property
    def noise(self) -> float:
        """Return how many times as noisy as its law depth is, at least 1. Noise that neighbouring pixels share does not
        show in one image, only between two: half of the differences are then below 0.67 standard deviations."""
        return max(1.0, median(self.residuals or [0.0]) / MEDIAN_NORMAL)

    def learns_noise(self, c: Comparison | None) -> bool:
        """Return whether depth is noisier than thought, and learn it, from one of the first frames: gray values confirm
        its pose."""
        sure = c is not None and len(self.residuals) < FEW and c.correlation > LEARNS_CORRELATION
        if c is None or not sure or c.residual <= MEDIAN_NORMAL:
            return False
        self.residuals.append(c.residual * self.noise)
        return True
