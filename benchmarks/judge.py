"""Fit the probability that a pose is wrong (tracking/pose_validation.py) to pairs of frames with known truth.

Two frames of a recording, disturbed as in robustness.py, are aligned from a guess that is off by a random motion. The
pose is wrong if it shifts the image by more than 5 % of the depth. A model that is fitted to all recordings but one is
judged on that one. The corridor is only judged: its walls repeat, so that wrong poses look right. Prints the weights,
which belong into pose_validation.py. Two processes.

example: python benchmarks/judge.py --number 1200
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import board_runs
import numpy as np
import program
import record
import tyro
from disturbances import DISTURBANCES, Color, Depth, Moment
from disturbed_recordings import Original, original
from failure_probability import Values, judged
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from tables import Section, significant

from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.fit.compare import best_alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.render.view import View
from sigmasplat.tracking.pose_validation import DOUBTFUL, LOST, SURE, WEIGHTS, TrackingStatistics, evidence
from sigmasplat.tracking.prepared_frame import observe, view_of, working_frame

arg = tyro.conf.arg
ONLY_JUDGED = "synthetic:corridor"
WALLS = tuple(f"synthetic:wall={paint},noise=1" for paint in (1, 2, 3))
SOURCES = (
    "fr1_xyz", "livingroom", "redkitchen", "hololens", "cubicles", "cabinet58", accuracy.SYNTHETIC, *WALLS, ONLY_JUDGED
)  # fmt: skip
OF_THE_CAMERA = (
    "clean", "clean", "blur", "color-noise", "depth-noise", "shared-noise", "coarse-depth", "edge-erosion", "missing",
    "range-clip", "little-contrast",
)  # fmt: skip
"""Disturbances of both images."""
OF_ONE_IMAGE = ("moving-object", "brightness")
"""Disturbances of the second image alone."""
SHRINK = 1.0
"""Weight of the squared weights in the loss: correlated quantities share their weight."""
CONFIG = preset(default_preset())
RIGHT, WRONG = 0.03, 0.05
"""A pose that shifts the image by less than the first share of the depth is right, by more than the second wrong. In
between, the truth's own errors decide; such pairs are left out."""
MOST_APART, GUESSES, LEAST_POINTS = 25, 4, 100
GUESS = (0.002, 0.5)
"""Standard deviations of the guesses, as shares of the depth and (times 0.7) in radians: uniform in the logarithm."""
MOST_FRAMES = 300
LIMITS = {"lost": LOST, "doubtful": DOUBTFUL, "not sure": SURE}
BINS = (0.0, 0.01, 0.03, 0.1, 0.3, 0.7, 0.9, 1.0)


@dataclass(frozen=True)
class Options:
    """Fit the probability that a pose is wrong to pairs of frames with known truth."""

    sources: Annotated[tuple[str, ...], arg(help="recordings with truth: names in the data folder, or paths")] = SOURCES
    number: Annotated[int, arg(help="number of poses of each recording")] = 1200
    seed: Annotated[int, arg(help="draws pairs, disturbances and guesses")] = 0
    name: Annotated[str, arg(help="name of the results")] = "judge"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(eq=False)
class Pairs:
    """Draws pairs of frames of a recording."""

    images: Original
    random: np.random.Generator
    view: View | None = None

    def changed(self, name: str, severity: int, index: int) -> tuple[Color, Depth]:
        """Return a frame as a disturbance changes it."""
        level, change = DISTURBANCES[name].levels[severity - 1], DISTURBANCES[name].change
        at = Moment(
            self.random, 0, int(self.random.integers(10)), float(self.random.random()), self.images.depth_quantile
        )
        return change(np.asarray(self.images.color_of(index)), self.images.depth_m(index), level, at)

    def pyramid(self, color: Color, depth: Depth) -> Pyramid:
        """Return a frame as tracking aligns it."""
        frame = Frame(0, 0.0, color.astype(np.float32) / 255.0, depth, self.images.camera)
        working = working_frame(frame, CONFIG)
        self.view = self.view or view_of(working.camera, CONFIG)
        return observe(frame, working, self.view, None).live

    def drawn(self) -> tuple[Pyramid, Pyramid, NDArray[np.float64]] | None:
        """Return two images and their true motion T_b_a [4, 4]; None if the second frame is outside the recording."""
        a, apart = int(self.random.integers(len(self.images))), int(np.exp(self.random.uniform(0, np.log(MOST_APART))))
        b = a + apart * int(self.random.choice((-1, 1)))
        if not 0 <= b < len(self.images):
            return None
        name = str(self.random.choice((*OF_THE_CAMERA, *OF_ONE_IMAGE)))
        severity = int(self.random.integers(1, len(DISTURBANCES[name].levels) + 1))
        first = "clean" if name in OF_ONE_IMAGE else name
        shown = self.changed(first, severity if first == name else 1, a), self.changed(name, severity, b)
        T_world_camera = self.images.T_world_camera
        return *(self.pyramid(*each) for each in shown), se3.inverse(T_world_camera[b]) @ T_world_camera[a]


def measure_source(source: str, number: int, seed: int, scratch: Path) -> dict[str, list[Any]]:
    """Return the evidence for so many poses of a recording, and by how much each shifts the image."""
    board_runs.one_thread()
    located = source if source.startswith("synthetic") else accuracy.located(source)
    pairs = Pairs(original(located, 0.0, scratch, MOST_FRAMES), np.random.default_rng(seed))
    weight, inputs, shifts = CONFIG.tracking.align_weight_color, list[list[float]](), list[float]()
    while len(shifts) < number:
        found = pairs.drawn()
        if found is None or len(found[0].points) < LEAST_POINTS:
            continue
        a, b, T_b_a = found
        points, statistics = a.points, TrackingStatistics()
        if statistics.learns_noise(best_alignment(a, b, T_b_a, weight)[1]):
            b = b.noisier(statistics.noise)
        for _ in range(GUESSES):
            off = np.exp(pairs.random.uniform(*np.log(GUESS))) * pairs.random.normal(size=6)
            twist = off * np.repeat([float(points[:, 2].mean()), 0.7], 3)
            motion, seen = best_alignment(a, b, se3.exp(twist) @ T_b_a, weight)
            if not np.isfinite(seen.residual):
                continue  # next to nothing in common: `p_wrong` needs no model
            truly, moved = (points @ T[:3, :3].T + T[:3, 3] for T in (T_b_a, motion.T_live_reference))
            shifts.append(float(np.median(np.linalg.norm(moved - truly, axis=1) / points[:, 2])))
            inputs.append([evidence(seen)[name] for name in WEIGHTS])
    return {"inputs": inputs, "shifts": shifts}


@dataclass(frozen=True, eq=False)
class Poses:
    """Evidence [N, K] for poses, and which are wrong [N]."""

    inputs: Values
    wrong: NDArray[np.bool_]

    @staticmethod
    def of(found: dict[str, list[Any]]) -> "Poses":
        """Leave out the poses whose truth is not exact enough."""
        shifts = np.array(found["shifts"])
        known = (shifts < RIGHT) | (shifts > WRONG)
        return Poses(np.array(found["inputs"])[known], shifts[known] > WRONG)

    @staticmethod
    def joined(parts: list["Poses"]) -> "Poses":
        """Return the poses of some recordings."""
        return Poses(np.concatenate([p.inputs for p in parts]), np.concatenate([p.wrong for p in parts]))

    def fitted(self) -> Values:
        """Return bias and weights [1 + K] of the most likely logistic model; no quantity may lower the probability."""
        x = np.column_stack([np.ones(len(self.inputs)), self.inputs])

        def loss(weights: Values) -> tuple[float, Values]:
            z = x @ weights
            value = np.logaddexp(0.0, z).sum() - z[self.wrong].sum() + 0.5 * SHRINK * (weights[1:] ** 2).sum()
            return float(value), x.T @ (expit(z) - self.wrong) + SHRINK * np.concatenate([[0.0], weights[1:]])

        bounds = [(None, None)] + [(0.0, None)] * self.inputs.shape[1]
        start, most = np.zeros(x.shape[1]), {"maxiter": 2000}
        return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=most).x)


def probability(weights: Values, inputs: Values) -> Values:
    """Return the probability of each pose to be wrong [N]."""
    return np.asarray(expit(weights[0] + inputs @ weights[1:]))


def shares(p: Values, wrong: NDArray[np.bool_]) -> dict[str, list[float]]:
    """Return for each limit the shares of right and of wrong poses above it."""
    return {name: [float((p[~wrong] > at).mean()), float((p[wrong] > at).mean())] for name, at in LIMITS.items()}


def measure(options: Options) -> dict[str, Any]:
    """Draw poses, fit a model, judge each recording by a model without it."""
    with TemporaryDirectory(prefix="judge-") as scratch, ProcessPoolExecutor(2) as pool:
        work = partial(measure_source, number=options.number, seed=options.seed, scratch=Path(scratch))
        poses = dict(zip(options.sources, map(Poses.of, pool.map(work, options.sources)), strict=True))
    used = {name: each for name, each in poses.items() if name != ONLY_JUDGED}
    weights = Poses.joined(list(used.values())).fitted()
    held_out, chances = {}, dict[str, Values]()
    for name, each in poses.items():
        without = Poses.joined([other for key, other in used.items() if key != name]).fitted()
        p = chances[name] = probability(without, each.inputs)
        held_out[name] = judged(p, each.wrong) | {"above": shares(p, each.wrong)}
    p, wrong = np.concatenate([chances[name] for name in used]), Poses.joined(list(used.values())).wrong
    bins = [(p > low) & (p <= high) for low, high in pairwise(BINS)]
    return {
        "bias": float(weights[0]), "weights": dict(zip(WEIGHTS, weights[1:].tolist(), strict=True)),
        "held_out": held_out, "all": judged(p, wrong) | {"above": shares(p, wrong)},
        "bins": {f"≤ {high}": judged(p[b], wrong[b]) for high, b in zip(BINS[1:], bins, strict=True) if b.any()},
    }  # fmt: skip


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate how well poses of recordings are judged that the model was not fitted to."""
    found = measured["figures"]
    rows = [
        [name, str(s["frames"]), f"{100 * s['off']:.0f} %", significant(s["auroc"]), significant(s["brier"]),
         *(f"{100 * right:.1f}, {100 * wrong:.1f}" for right, wrong in s["above"].values())]
        for name, s in (found["held_out"] | {"all but the corridor": found["all"]}).items()
    ]  # fmt: skip
    head = ["recording", "poses", "wrong", "AUROC", "Brier", *(f"{name}: right, wrong, %" for name in LIMITS)]
    weights = {"bias": found["bias"]} | found["weights"]
    bins = [[significant(b["mean"]), significant(b["off"]), str(b["frames"])] for b in found["bins"].values()]
    return [
        Section("Each recording by a model without it", head, rows),
        Section("Stated and true, without the corridor", ["p(wrong), mean", "share wrong", "poses"], bins),
        Section("Weights", ["quantity", "weight"], [[name, significant(w)] for name, w in weights.items()]),
    ]


def main(options: Options) -> int:
    """Fit, write the results, print the tables; return the exit code."""
    return program.run("judge", options, measure, (options.seed,))


if __name__ == "__main__":
    program.start(main, Options)
