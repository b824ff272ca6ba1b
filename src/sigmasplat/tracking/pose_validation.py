"""Judge a pose by comparing surfaces: accept it, doubt it, or call the camera lost."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit

MEDIAN_NORMAL = 0.6745
"""The median of |x| if x is a standard normal number."""
RECENT = 50
"""What is usual is the median over this many recent frames that were not lost."""
FEW = 5
"""With fewer values, defaults are used instead of what is usual."""
LOST_CLOSE, LOST_EXPLAINED = 0.3, 0.85
"""Lost: `close`, or `explained`, is below this. Something large in front of the camera lowers the first; only a wrong
pose lowers the second."""
DOUBT = 0.7
"""A pose is doubtful if its agreement × overlap falls below this share of the usual value."""
DOUBT_CLOSE, DOUBT_EXPLAINED = 0.9, 0.95
"""Doubtful: `close` is below this share of its usual value, or `explained` is below this."""
COVERED_CLOSE = 0.7
"""Something large has moved into the view if less than this share of what is usual is the same surface. A nearer wall
that comes into view covers less from one keyframe to the next."""
DOUBT_RESIDUAL = 2.5
"""Doubtful: the median depth difference is this many times the usual one."""
DOUBT_CORRELATION, LOST_CORRELATION = 0.85, 0.4
"""Doubtful or lost: the correlation of the gray values is below this share of its usual value. The depth of a flat
surface fits at many poses, its texture at one."""
LOST_RESIDUAL = 6.0
"""Lost: the median depth difference is above this many times the usual one, or above this many standard deviations of
a reading if the usual one is smaller than one. Clean recordings stay below 1."""
LEAST_COMMON, LEAST_CLOSE, LEAST_EXPLAINED, LEAST_CORRELATION, MOST_RESIDUAL = 0.25, 0.75, 0.9, 0.8, 1.5
"""The pose of a lost camera is confirmed if `common`, `close`, `explained` and `correlation` are at least this, and if
`residual`, in standard deviations of a reading, is at most this."""
FEW_MATCHES, SURE_EXPLAINED, SURE_CORRELATION = 15, 0.97, 0.9
"""With fewer matches, a pose without a known path needs at least these values: a dozen features of one wall also match
another wall, and walls are alike."""
MOST_SPREAD_M = 0.05
"""A pose without a known path is refused if the standard deviation of its position is larger: where only a wall is in
view, the images agree as well at every pose along it."""
DOUBT_SCORE, FIRST_SCORE = 0.7, 0.8
"""Doubtful: the score falls below this share of the usual one, which is the second value while it is not known. A frame
and its keyframe share four fifths of their surface, or less: with 1, the fifth frame of a turn was doubtful."""
PATIENCE, STANDS_CORRELATION = 3, 0.7
"""A doubtful pose is used for mapping after this number of doubtful frames in a row, if the surfaces confirm it with
this correlation: blur and exposure lower the correlation at right poses too."""
DIFFERS, DRAWS = 0.02, 2.5
"""A moving thing may have pulled the pose if 1 − correlation of the gray values is above the first value. It has pulled
the pose if 1 − correlation falls by more than the second, a factor, when the thing is left out. For still things in
recordings the factor was below 2."""
SUSPECTED = 1.3
"""A thing is suspected if 1 − correlation falls by this factor when the thing is left out at the same pose. The factor
is low because a pulled pose lies between the motion of the camera and that of the thing, where the rest of the image
does not agree either: it is 1.6 to 2.0 for a ball that covers a tenth of the image. The pose is then fitted without the
thing, and the other tests decide."""
DISAGREES = 1.5
"""A suspected thing moves only if it disagrees with the rest of the image: at the pose fitted without the thing,
1 − correlation is this many times larger with the thing than without it. Otherwise the first pose was a poor fit."""
AGREES_MORE = 0.05
"""A thing has also pulled a doubtful pose if leaving it out raises the correlation of the gray values by this."""


def explained(c: Comparison) -> float:
    """Return the share of close points among those that nothing in front covers, in [0, 1]."""
    return c.close / max(c.close + c.behind, 1e-9)


def score(c: Comparison) -> float:
    """Return the share of the reference that a pose explains, in [0, 1]; it is lower if known surfaces are seen through
    or the gray values do not correlate."""
    texture = 1.0 if np.isnan(c.correlation) else max(c.correlation, 0.0)
    return c.common * c.close * explained(c) * texture


def confirmed(c: Comparison, least_correlation: float = LEAST_CORRELATION) -> bool:
    """Return whether the map confirms a pose without any knowledge of the camera's path."""
    return (
        c.common >= LEAST_COMMON
        and c.close >= LEAST_CLOSE
        and c.covered >= LEAST_COMMON
        and explained(c) >= LEAST_EXPLAINED
        and c.residual <= MOST_RESIDUAL
        and not c.correlation < least_correlation
    )


def recognised(c: Comparison, matches: int) -> bool:
    """Return whether the map confirms a pose that this number of features has led to."""
    sure = explained(c) >= SURE_EXPLAINED and not c.correlation < SURE_CORRELATION
    return confirmed(c) and (sure or matches >= FEW_MATCHES)


def differs(c: Comparison) -> bool:
    """Return whether the gray values differ so much that something may have pulled the pose."""
    return 1.0 - c.correlation > DIFFERS


def agrees_more(without: Comparison | None, c: Comparison | None, contradicted: bool) -> bool:
    """Return whether something has pulled a pose, by a comparison without it; contradicted: the pose was doubtful."""
    if without is None or c is None:
        return False
    much = differs(c) and DRAWS * (1.0 - without.correlation) < 1.0 - c.correlation
    return much or (contradicted and without.correlation > c.correlation + AGREES_MORE)


def may_draw(without: Comparison, c: Comparison | None) -> bool:
    """Return whether something may have pulled a pose, by a comparison without it at the same pose."""
    return c is not None and differs(c) and SUSPECTED * (1.0 - without.correlation) < 1.0 - c.correlation


def gray_gain(c: Comparison, better: Comparison) -> float:
    """Return what the gray values miss to a correlation of 1, relative to what they miss at a better pose, minus 1; NaN
    for flat images."""
    return (1.0 - c.correlation) / max(1.0 - better.correlation, 1e-9) - 1.0


def disagrees(whole: Comparison, without: Comparison | None) -> bool:
    """Return whether something does not agree with the rest, by comparisons with and without it at the same pose."""
    return without is not None and 1.0 - whole.correlation > DISAGREES * (1.0 - without.correlation)


def is_missed(without: Comparison | None, whole: Comparison | None) -> bool:
    """Return whether a thing that was left out belongs to the still scene: the fit is worse without it. The images
    agree less, in depth and in gray, at the pose fitted without the thing than with the thing at the first pose."""
    if without is None or whole is None or without.close >= whole.close:
        return False
    return not 1.0 - without.correlation <= DISAGREES * (1.0 - whole.correlation)


def stands(c: Comparison, doubtful: int) -> bool:
    """Return whether a pose is used for mapping although it is the last of this number of doubtful ones in a row."""
    return doubtful > PATIENCE and confirmed(c, STANDS_CORRELATION)


def is_lost(fit: PoseFit, least_agreement: float, least_share: float) -> bool:
    """Return whether tracking failed: the depths of map and sensor disagree, or too few pixels are in common."""
    return fit.agreement < least_agreement or fit.agreement * fit.overlap < least_share


def jumped(value: float, history: Sequence[float], factor: float) -> bool:
    """Return whether a loss exceeds `factor` times the median of the recent losses (VarSplat §3, re-initialisation)."""
    return len(history) >= 5 and value > factor * float(np.median(history[-50:]))


@dataclass(eq=False)
class TrackingStatistics:
    """Values of recent frames that were not lost; their medians are what is usual. residuals: in standard deviations of
    the law of the sensor, however noisy depth is."""

    scores: list[float] = field(default_factory=list)
    closes: list[float] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    correlations: list[float] = field(default_factory=list)

    def add(self, c: Comparison) -> None:
        """Add the values of a frame that is not lost."""
        for values, value in (
            (self.scores, score(c)), (self.closes, c.close), (self.residuals, c.residual * self.noise),
            (self.correlations, c.correlation),
        ):  # fmt: skip
            if np.isfinite(value):
                values.append(value)
                del values[:-RECENT]

    def is_lost(self, c: Comparison, least_share: float) -> bool:
        """Return whether a pose is refuted, or has less than `least_share` of the reference in common."""
        return (
            c.close < LOST_CLOSE
            or explained(c) < LOST_EXPLAINED
            or c.residual > LOST_RESIDUAL * max(1.0, _median(self.residuals, 0.0) / self.noise)
            or c.correlation < LOST_CORRELATION * _median(self.correlations, 0.8)
            or c.common < least_share
        )

    @property
    def noise(self) -> float:
        """Return how many times as noisy as its law depth is, at least 1. Noise that neighbouring pixels share does not
        show in one image, only between two: half of the differences are then below 0.67 standard deviations."""
        return max(1.0, median(self.residuals or [0.0]) / MEDIAN_NORMAL)

    def learns_noise(self, c: Comparison | None) -> bool:
        """Return whether depth is noisier than thought, and learn it, from one of the first frames: gray values confirm
        its pose."""
        sure = c is not None and len(self.residuals) < FEW and c.correlation > SURE_CORRELATION
        if c is None or not sure or c.residual <= MEDIAN_NORMAL:
            return False
        self.residuals.append(c.residual * self.noise)
        return True

    @property
    def residual(self) -> float:
        """Return the usual median depth difference, in standard deviations of a reading; NaN if it is not known."""
        return _median(self.residuals, float("nan")) / self.noise

    def doubts(self, c: Comparison) -> bool:
        """Return whether a pose is clearly worse than usual."""
        usual_score = _median(self.scores, FIRST_SCORE)
        worse = c.close < DOUBT_CLOSE * _median(self.closes, 1.0) or score(c) < DOUBT_SCORE * usual_score
        return worse or self.contradicts(c)

    def agrees_less(self, c: Comparison | None) -> bool:
        """Return whether the gray values agree so much less than usual that something may have pulled the pose far."""
        return c is not None and 1.0 - c.correlation > DRAWS * max(1.0 - _median(self.correlations, 0.9), DIFFERS)

    def contradicts(self, c: Comparison) -> bool:
        """Return whether what both images show differs clearly more than usual, however much they share."""
        return (
            c.close < COVERED_CLOSE * _median(self.closes, 1.0)
            or explained(c) < DOUBT_EXPLAINED
            or c.residual > DOUBT_RESIDUAL * max(0.2, _median(self.residuals, 1.0) / self.noise)
            or c.correlation < DOUBT_CORRELATION * _median(self.correlations, 0.9)
        )


def _median(values: Sequence[float], otherwise: float) -> float:
    return median(values) if len(values) >= FEW else otherwise  # of 50 values, four times faster than NumPy's
