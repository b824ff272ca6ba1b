"""Check times and consecutive frames of a recording: unit, order, gaps; delay between colour and depth, jumps of the
view, black frames.

Every frame is reduced to a few thousand pixels. The motion energy of a frame is its mean change since the frame before,
of colour and of depth. Both follow the motion of the camera, so that their best correlation is at the delay between
them.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sigmasplat.api import Frame, Source, SourceError

PLAUSIBLE_RATE_HZ = (0.1, 1000.0)
"""Frame rates of cameras, also of recordings that keep every tenth frame; with times in another unit it is outside."""
GAP_S, GAP_STEPS = 1.0, 10.0
"""A gap is longer than `GAP_S` and than this multiple of the median step."""


def times_of(source: Source) -> NDArray[np.float64]:
    """Return the times of all frames whose files can be read, seconds [N]."""
    times = []
    for i in range(len(source)):
        try:
            times.append(source.timestamp_s(i))
        except SourceError:
            continue  # reported when the frame is read
    return np.array(times)


def rate(times_s: NDArray[np.float64]) -> str:
    """Write the usual number of frames per second for times in seconds [N]: one over the median step."""
    middle_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if middle_s <= 0.0:
        return "–"
    return f"{1.0 / middle_s:.1f}" if middle_s < 10.0 else f"{1.0 / middle_s:.2g}"


def time_warnings(times_s: NDArray[np.float64]) -> list[str]:
    """Return warnings about the times of the frames, seconds [N]; [] if they are plausible."""
    steps_s = np.diff(times_s)
    if not len(steps_s):
        return []
    warnings = []
    backward = np.flatnonzero(steps_s <= 0)
    if len(backward):
        warnings.append(
            f"{len(backward)} frames have the same time as the frame before, or an earlier one (first: frame "
            f"{backward[0] + 1} at {times_s[backward[0] + 1]:.3f} s); correct the times"
        )
    middle_s = float(np.median(steps_s))
    low, high = PLAUSIBLE_RATE_HZ
    if middle_s > 0 and not low <= 1.0 / middle_s <= high:
        warnings.append(f"the times give {rate(times_s)} frames per second; write times in seconds")
        return warnings
    gaps = np.flatnonzero(steps_s > max(GAP_S, GAP_STEPS * middle_s))
    if len(gaps):
        longest = int(gaps[steps_s[gaps].argmax()])
        warnings.append(
            f"{len(gaps)} gaps in time (longest: {steps_s[longest]:.1f} s after frame {longest}); tracking may be "
            "lost there: use one part with --start and --end"
        )
    return warnings


Numbers = NDArray[np.float64]
Reduced = tuple[float, NDArray[np.float32], NDArray[np.float32]]
"""Time in seconds, small gray image [h, w], small depth image [h, w] in metres."""

WIDTH, REACH, FEWEST = 80, 8, 40
"""Image width, pixels, at which frames are compared; largest delay that is searched, frames; a delay is estimated from
at least this many frames."""
MIN_CORRELATION, SURE, MIN_DELAY = 0.6, 2.0, 0.7
"""Below this correlation of the motion energies the delay is unknown. It is reported if its correlation is above that
without a delay by so many standard deviations (`_sureness`), and if it has at least so many frames."""
JUMP, JUMP_LEAST, BLACK = 2.8, 0.08, 0.02
"""A view jumps if the image changes by more than this multiple of the median change around it, and by at least this on
average; a frame is black if 99 % of its pixels are below this; colours 0 to 1."""
MANY_HOLES = 0.45
"""If more than this share of the pixels has no depth, warn."""
RECENT, EVERY_S = 80, 1.0
"""While a run goes on, so many recent frames are compared with the first ones, once in so many seconds."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Consecutive frames, reduced: times [N] in seconds, gray images [N, h, w], depth in metres [N, h, w], 0 = none."""

    times_s: Numbers
    gray: NDArray[np.float32]
    depth_m: NDArray[np.float32]

    @staticmethod
    def of(frames: Iterable[Frame]) -> "Motion":
        """Reduce the frames."""
        return Motion.joined([(frame.timestamp_s, reduced(frame.color), thinned(frame.depth_m)) for frame in frames])

    @staticmethod
    def joined(frames: Iterable["Reduced"]) -> "Motion":
        """Join reduced frames."""
        times, grays, depths = zip(*frames, strict=True) if frames else ((), (), ())
        return Motion(np.array(times), np.array(grays, np.float32), np.array(depths, np.float32))

    def changes(self) -> Numbers:
        """Return the mean change of the image between neighbouring frames, without the change of mean brightness."""
        plain = self.gray - self.gray.mean((1, 2), keepdims=True)
        return np.asarray(np.abs(np.diff(plain, axis=0)).mean((1, 2)), np.float64)

    def depth_changes(self) -> Numbers:
        """Return the mean relative change of depth between neighbouring frames, over pixels with depth in both."""
        first, second = self.depth_m[:-1], self.depth_m[1:]
        both = (first > 0) & (second > 0)
        ratio = np.log(np.where(both, second, 1.0) / np.where(both, first, 1.0))
        return np.asarray(np.minimum(np.abs(ratio), 0.2).sum((1, 2)) / np.maximum(both.sum((1, 2)), 1), np.float64)

    def delay_frames(self) -> float | None:
        """Return by how many frames depth is behind colour; None if it is unknown, or too small to be reported."""
        if len(self.times_s) < FEWEST:
            return None
        color, depth = _varying(self.changes()), _varying(self.depth_changes())
        lags = np.arange(-REACH, REACH + 1)
        scores = np.array([_correlation(color, depth, int(lag)) for lag in lags])
        best = int(scores.argmax())
        if not 0 < best < len(lags) - 1 or scores[best] < MIN_CORRELATION:
            return None
        if _sureness(scores[best], scores[REACH], color, depth) < SURE:
            return None
        below, peak, above = scores[best - 1 : best + 2]
        delay = float(lags[best] + 0.5 * (below - above) / (below - 2 * peak + above - 1e-12))
        return delay if abs(delay) >= MIN_DELAY else None


@dataclass(eq=False)
class MotionWatch:
    """Looks for black and jumping frames, and every second for what drifts: the share of pixels without depth, compared
    with the start, and the delay between colour and depth. It keeps two numbers per frame, and `RECENT` small images.

    warn: gets what has changed at once, in one line, each kind once.
    """

    warn: Callable[[str], None] = lambda line: None
    numbers: list[int] = field(default_factory=list)
    black: list[int] = field(default_factory=list)
    changes: list[float] = field(default_factory=list)
    last: NDArray[np.float32] | None = None
    recent: deque[Reduced] = field(default_factory=lambda: deque(maxlen=RECENT))
    holes_at_first: float | None = None
    told: set[str] = field(default_factory=set)
    looked_s: float = -np.inf

    def __call__(self, frame: Frame) -> None:
        """Take the next frame into account."""
        gray = reduced(frame.color)
        self.add(frame.index, gray)
        self.recent.append((frame.timestamp_s, gray, thinned(frame.depth_m)))
        if frame.timestamp_s - self.looked_s >= EVERY_S:
            self.look(frame.index)
            self.looked_s = frame.timestamp_s

    def look(self, number: int) -> None:
        """Compare the recent frames with the first ones, and warn of what has changed."""
        motion = Motion.joined(self.recent)
        holes, late = float((motion.depth_m == 0).mean()), late_warning(motion)
        if self.holes_at_first is None:
            self.holes_at_first = holes
        found = {"late": f"about frame {number}: {late}"} if late else {}
        if holes > MANY_HOLES and holes > 2.0 * self.holes_at_first:
            found["holes"] = (
                f"about frame {number}: {holes:.0%} of the pixels have no depth, {self.holes_at_first:.0%} at first; "
                "go nearer, or away from sunlight, glass and black surfaces"
            )
        for kind in found.keys() - self.told:
            self.warn(found[kind])
        self.told |= found.keys()

    def add(self, number: int, gray: NDArray[np.float32]) -> None:
        """Take the next frame into account, as a gray image."""
        if float(np.percentile(gray, 99)) < BLACK:
            self.black.append(number)
        gray = gray - gray.mean()
        if self.last is not None:
            self.changes.append(float(np.abs(gray - self.last).mean()))
        self.numbers.append(number)
        self.last = gray

    def warnings(self) -> list[str]:
        """Return warnings about the frames so far, without those that were told."""
        if self.recent:
            self.look(self.numbers[-1])
        change, warnings = np.array(self.changes), list[str]()
        usual = ndimage.median_filter(change, size=min(21, len(change)), mode="nearest") if len(change) else change
        jumps = np.array(self.numbers)[1:][(change > JUMP * usual) & (change > JUMP_LEAST)].tolist()
        if self.black:
            warnings += [f"{len(self.black)} frames are black (first: frame {self.black[0]}); remove or correct them"]
        if jumps:
            where = f"the view jumps {len(jumps)} times (first: before frame {jumps[0]})"
            warnings.append(f"{where}; tracking may be lost there")
        return warnings


def reduced(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a gray image about `WIDTH` pixels wide from colours [H, W, 3]: means of squares of about 2 × 2 pixels;
    of larger images only some rows and columns are read."""
    apart = max(1, color.shape[1] // (2 * WIDTH))
    color = color[::apart, ::apart]
    step = max(1, color.shape[1] // WIDTH)
    height, width = (size // step * step for size in color.shape[:2])
    rows = color[:height, :width].reshape(height // step, step, width // step, step * 3)
    return np.asarray(rows.mean((1, 3)), np.float32)


def thinned(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a copy of every k-th reading of a depth image [H, W], about `WIDTH` pixels wide."""
    step = max(1, depth_m.shape[1] // WIDTH)
    height, width = (size // step * step for size in depth_m.shape)
    return depth_m[step // 2 : height : step, step // 2 : width : step].copy()


def _varying(energy: Numbers) -> Numbers:
    """Return the fast part of the logarithm of an energy, without its slow trend and without outliers."""
    level = np.log(energy + 1e-4)
    fast = level - ndimage.gaussian_filter1d(level, 10.0, mode="nearest")
    spread = 1.4826 * float(np.median(np.abs(fast - np.median(fast)))) + 1e-9
    return np.asarray(np.clip(fast, -4 * spread, 4 * spread))


def _correlation(first: Numbers, second: Numbers, lag: int) -> float:
    a = first[: len(first) - lag] if lag >= 0 else first[-lag:]
    b = second[lag:] if lag >= 0 else second[: len(second) + lag]
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0


def _sureness(higher: float, lower: float, first: Numbers, second: Numbers) -> float:
    """Return by how many standard deviations two correlations of the same series differ (Fisher 1921), if they were
    independent. A smooth motion has fewer independent frames than frames (Bartlett 1946)."""
    a, b = ((values - values.mean()) / (values.std() + 1e-12) for values in (first, second))
    lags = np.arange(1, len(a) // 2)
    shared = sum(2.0 * (1.0 - k / len(a)) * (a[k:] * a[:-k]).mean() * (b[k:] * b[:-k]).mean() for k in lags)
    independent = len(a) / max(1.0 + shared, 1.0)
    apart = np.diff(np.arctanh(np.clip([lower, higher], -0.999, 0.999)))
    return float(apart[0] * np.sqrt(max(independent - 3.0, 0.0) / 2.0))


def motion_warnings(motion: Motion, first: int = 0) -> list[str]:
    """Return warnings about consecutive frames; `first` is the number of the first one in the recording."""
    late, watch = late_warning(motion), MotionWatch()
    for i, gray in enumerate(motion.gray):
        watch.add(first + i, gray)
    return [late] * bool(late) + watch.warnings()


def late_warning(motion: Motion) -> str:
    """Return a warning if depth is behind colour, or colour behind depth, by consecutive frames; otherwise ""."""
    delay = motion.delay_frames()
    if delay is None:
        return ""
    seconds = abs(delay) * float(np.median(np.diff(motion.times_s)))
    late, early = ("depth", "colour") if delay > 0 else ("colour", "depth")
    return (
        f"{late} is {seconds:.3f} s ({abs(delay):.1f} frames) behind {early}, judged by the motion of both; "
        "`sigmasplat calibrate PATH` measures it, and a run corrects it; if neither finds it, subtract it from the "
        f"times of {late}"
    )
