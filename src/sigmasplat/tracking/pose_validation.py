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
WEIGHTS = {"unexplained": 1.11, "uncorrelated": 1.92, "moved": 6.14}
BIAS = 4.65
"""The log odds that a pose is wrong are BIAS + Σ weight · quantity (`evidence`). `benchmarks/judge.py` fits them to
pairs of frames with known truth, aligned from random guesses of which a quarter lead to a wrong pose."""
LOST, DOUBTFUL, SURE = 0.5, 0.1, 0.03
"""Limits of this probability. A tracked pose is lost where it is more likely wrong than right, for a lost frame only
costs itself. Above the second it is doubtful, and tried again from other guesses, which cost little. Below the third, a
pose counts without a path that leads to it: a wrong loop bends the whole map."""
DOUBT = 0.7
"""Without a comparison, a pose is doubtful if its agreement × overlap falls below this share of the usual value."""
RESTARTS = {"longer": 5.0, "odometry": 50.0}
"""The multiple of the usual loss above which a descent starts again, by `tracking.restart` (VarSplat's code)."""
FEW_MATCHES = 15
"""A pose from fewer matches, without a known path, must be three times as sure: a dozen features of one wall also match
another wall, and walls are alike."""
HELD_FLAT = 0.12
"""Images without texture confirm a pose as far as depth holds it: as a correlation of 1 − exp(−held / HELD_FLAT)."""
LEARNS_CORRELATION = 0.9
"""Gray values that correlate as much confirm a pose by themselves."""
MOST_SPREAD_M = 0.05
"""A pose without a known path is refused if the standard deviation of its position is larger: where only a wall is in
view, the images agree as well at every pose along it."""


def evidence(c: Comparison) -> dict[str, float]:
    """Return the quantities by which a pose is judged: logarithms of the share of the surface that is seen through and
    of what the gray values miss to a correlation of 1, and how far the pose is from its guess, more so if the images
    hardly hold it. The last is no logarithm: a small distance does not make a pose right."""
    seen, flat = c.close + c.behind, np.isnan(c.correlation)
    correlation = 1.0 - math.exp(-c.held / HELD_FLAT) if flat else max(c.correlation, 0.0)
    return {
        "unexplained": math.log(c.behind / max(seen, 1e-9) + 0.01),
        "uncorrelated": math.log(1.02 - correlation),
        "moved": min(c.moved, 1.0) * max(-math.log(c.held + 0.01), 0.0),
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


def is_lost(fit: PoseFit, least_agreement: float, least_share: float) -> bool:
    """Return whether tracking failed: the depths of map and sensor disagree, or too few pixels are in common."""
    return fit.agreement < least_agreement or fit.agreement * fit.overlap < least_share


def jumped(first_loss: float, last_losses: Sequence[float], restart: str) -> bool:
    """Return whether the first loss of a frame is so far above the last losses of recent frames that its descent starts
    again (VarSplat §3, re-initialisation)."""
    return restart in RESTARTS and bool(last_losses) and first_loss > RESTARTS[restart] * median(last_losses)


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
