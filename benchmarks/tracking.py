"""Compare tracking by alignment with the papers' descent, and both with the ground truth (issue 3).

pairs: track a frame a few frames after a keyframe, by every method from the same guess. consistency: does the
covariance of a pose cover its error? sequence: complete runs, made by `accuracy.py`, which reuses finished ones.
Writes benchmarks/results/tracking-<machine>.json and prints tables; benchmarks/README.md says what each figure means.

example: python benchmarks/tracking.py --experiments pairs consistency
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import accuracy
import numpy as np
import program
import record
import tyro
from cpu import alone, default_source
from numpy.typing import NDArray
from tracking_tables import coverage

from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.fit.pose import PoseFit, fit_pose_adam, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import map_reference
from sigmasplat.fit.target import Target, gray_of
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.sources import open_source
from sigmasplat.render.backend import make_view
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
Fit = Callable[[Frame, Matrix], PoseFit]
Experiment = Literal["pairs", "consistency", "sequence"]
RATES = {"TUM": (2e-3, 1e-2), "Replica": (2e-4, 2e-3)}
"""The papers' learning rates for tracking by Adam, by data set: rotation, translation."""


@dataclass(frozen=True)
class Options:
    """Compare tracking by alignment with the papers' descent, and both with the ground truth."""

    experiments: Annotated[tuple[Experiment, ...], arg(help="which ones to run")] = ("pairs", "consistency", "sequence")
    source: Annotated[str, arg(help="sequence for the pairs: name or path")] = field(default_factory=default_source)
    starts: Annotated[int, arg(help="number of keyframes, spread over the sequence")] = 12
    gaps: Annotated[tuple[int, ...], arg(help="distances from the keyframe to the tracked frame, in frames")] = (
        1,
        2,
        5,
        10,
    )
    before: Annotated[int, arg(help="frames that make the map at each start, including the start")] = 10
    rooms: Annotated[tuple[str, ...], arg(help="sequences for the covariance, with exact ground truth")] = (
        accuracy.SYNTHETIC,
        f"{accuracy.SYNTHETIC},noise=1",
    )
    sources: Annotated[tuple[str, ...], arg(help="sequences for complete runs: names or paths")] = (
        "redkitchen",
        "synthetic",
    )
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    iterations: Annotated[int, arg(help="Adam iterations per frame")] = 60
    rates: Annotated[tuple[str, ...], arg(help="data sets whose learning rates Adam uses on complete runs")] = tuple(
        RATES
    )
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one map for each")] = (0,)
    limit: Annotated[
        int | None,
        arg(help="number of frames at most, of rooms and complete runs", help_behavior_hint="(default: all)"),
    ] = None
    quick: Annotated[bool, arg(help="two minutes: few starts, short sequences, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "tracking"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self, seed: int) -> Config:
        """Return a run's settings. Raises ConfigError for an unknown preset."""
        return replace(preset_of(self.preset), seed=seed)


def true_poses(source: Source, timestamps_s: Sequence[float]) -> Matrix:
    """Return true T_world_camera [N, 4, 4] at the times of frames. Raises SourceError if one is missing."""
    truth = source.truth()
    rows = associate(np.array(timestamps_s), truth.timestamps_s)[1] if truth else np.empty(0, np.intp)
    if truth is None or len(rows) < len(timestamps_s):
        raise SourceError(
            f"{source.name}: {len(rows)} of {len(timestamps_s)} frames have a true pose; choose other frames"
        )
    return truth.T_world_camera[rows]


def relative_error(T_estimated: Matrix, T_true: Matrix) -> dict[str, float]:
    """Return the error of an estimated motion."""
    error = se3.inverse(T_true) @ T_estimated
    shift_m, angle_deg = float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.rotation_angle(error[:3, :3])))
    return {"translation_cm": round(100.0 * shift_m, 5), "rotation_deg": round(angle_deg, 6)}


def spread(frames: int, options: Options) -> list[int]:
    """Choose evenly spread starts with enough frames before and after. Raises SourceError if there are too few."""
    first, last = options.before - 1, frames - 1 - max(options.gaps)
    if first > last:
        raise SourceError(
            f"{frames} frames are too few: {options.before} are needed up to a start and {max(options.gaps)} after it"
        )
    return [int(start) for start in np.unique(np.linspace(first, last, options.starts).round())]


def map_before(source: Source, start: int, before: int, config: Config) -> Slam:
    """Run SLAM over the `before` frames up to `start`, the last one a keyframe by the normal rule unless lost."""
    slam = Slam(config)
    for i in range(start - before + 1, start):
        slam.step(source.frame(i))
    slam.config = replace(config, mapping=replace(config.mapping, every=1))
    slam.step(source.frame(start))
    return slam


def methods(slam: Slam, camera: Camera, iterations: int) -> dict[str, Fit]:
    """Return every method to fit a frame's T_camera_world from a guess, with the map after its last keyframe."""
    config, params, keyframe = slam.config.tracking, slam.field.params, slam.tracker.keyframe
    view = make_view(slam.config.backend, camera, slam.config.render)
    size = (view.sums.shape[1], view.sums.shape[2])

    def live(frame: Frame) -> Pyramid:
        return Pyramid.of(gray_of(frame.color), frame.depth_m, frame.camera)

    def to_map(frame: Frame, guess: Matrix) -> PoseFit:
        return fit_pose_align(map_reference(params, view, guess, config), live(frame), guess, config)

    def by_adam(rates: tuple[float, float]) -> Fit:
        chosen = replace(config, method="adam", lr_rotation=rates[0], lr_translation=rates[1])
        return lambda frame, guess: fit_pose_adam(params, view, Target.of(frame, size), guess, chosen, iterations)

    fits: dict[str, Fit] = {f"adam {name}": by_adam(rates) for name, rates in RATES.items()} | {"map": to_map}
    if keyframe is not None:
        fits["keyframe"] = lambda frame, guess: fit_pose_align(keyframe, live(frame), guess, config)
    return fits


def measure_pairs(path: str, options: Options) -> dict[str, Any]:
    """Fit the frames `gaps` after each start by every method from the start's own pose; return every error and time."""
    source, found, lost = open_source(path), [], 0
    starts = spread(len(source), options)
    for seed, start in ((seed, start) for seed in options.seeds for start in starts):
        slam = map_before(source, start, options.before, options.config(seed))
        if not slam.steps[-1].is_keyframe:
            lost += 1
            continue
        i, T_start_world = slam.config.input, se3.inverse(slam.steps[-1].T_world_camera)
        shown = [source.frame(start + n) for n in (0, *options.gaps)]
        frames = [frame.prepared(i.width, i.min_depth_m, i.max_depth_m, i.crop_px) for frame in shown]
        fits = methods(slam, frames[0].camera, options.iterations)
        truth = true_poses(source, [frame.timestamp_s for frame in frames])
        for gap, frame, T_true in zip(options.gaps, frames[1:], se3.inverse(truth[0]) @ truth[1:], strict=True):
            found.append({"gap": gap, "method": "guess", "ms": 0.0, **relative_error(np.eye(4), T_true)})
            for name, fit in fits.items():
                clock = time.perf_counter()
                T_live_world = fit(frame, T_start_world).T_camera_world
                ms = round(1e3 * (time.perf_counter() - clock), 3)
                error = relative_error(T_start_world @ se3.inverse(T_live_world), T_true)
                found.append({"gap": gap, "method": name, "ms": ms, **error})
        print(f"pairs from frame {start}, seed {seed}", file=sys.stderr, flush=True)
    return {"source": Path(path).name, "starts": starts, "lost": lost, "pairs": found}


def follow(source: Source, config: Config) -> tuple[Matrix, Matrix, Matrix, int]:
    """Track a sequence; return error twists [N, 6], covariances [N, 6, 6], frames since the keyframe [N], frames lost.

    The twist is log(T_estimated · T_true⁻¹) of T_live_keyframe, (ρ, φ), m and rad, as for the covariance.
    """
    slam, fits, followed, stamps = Slam(config), [], [], []
    track = slam.tracker.track

    def watched(*arguments: Any) -> PoseFit:
        fits.append(track(*arguments))
        return fits[-1]

    slam.tracker.track = watched  # type: ignore[method-assign]
    for frame in source:
        newest = slam.mapper.keyframes[-1:]
        T_world_keyframe = [keyframe.T_world_camera for keyframe in newest]  # before this step may move it
        slam.step(frame)
        for keyframe, T in zip(newest, T_world_keyframe, strict=True):
            fit, lost = fits[-1], slam.tracker.lost
            followed.append((len(stamps), keyframe.index, fit.T_camera_world @ T, fit.covariance, lost))
        stamps.append(frame.timestamp_s)
    truth = true_poses(source, stamps)
    known = [(i, k, T, S) for i, k, T, S, lost in followed if not lost and S is not None and np.isfinite(S).all()]
    twists = [se3.log(T @ se3.inverse(truth[k]) @ truth[i]) for i, k, T, _ in known]
    covariances, ages = [S for *_, S in known], np.array([i - k for i, k, *_ in known])
    return np.reshape(twists, (-1, 6)), np.reshape(covariances, (-1, 6, 6)), ages, len(followed) - len(known)


def measure_consistency(path: str, options: Options) -> dict[str, Any]:
    """Track a sequence with each seed; compare each pose's covariance with its error, for all frames and by age."""
    followed = [follow(open_source(path, limit=options.limit), options.config(seed)) for seed in options.seeds]
    twists, covariances, ages = (np.concatenate([run[k] for run in followed]) for k in range(3))
    if not len(twists):
        raise SourceError(f"{path}: no frame was tracked with a covariance; does the preset track by align?")
    by_age = {str(age): coverage(twists[ages == age], covariances[ages == age]) for age in np.unique(ages)}
    lost = sum(run[3] for run in followed)
    return {"source": path, "lost": lost, "all": coverage(twists, covariances), "by_age": by_age}


def measure_sequences(options: Options) -> list[dict[str, Any]]:
    """Run complete sequences by every method as `accuracy.py` does; a run that failed has a `problem`."""
    ways, jobs = {"align": ("tracking.method=align",)}, []
    for name in options.rates:
        rotation, translation = RATES[name]
        rates = (f"tracking.lr_rotation={rotation}", f"tracking.lr_translation={translation}")
        ways[f"adam {name}"] = ("tracking.method=adam", f"tracking.iterations={options.iterations}", *rates)
    for method, settings in ways.items():
        wanted = accuracy.Options(options.sources, (options.preset,), options.seeds, settings, options.limit)
        wanted = replace(wanted, fresh=options.fresh, runs=options.runs)
        for result in accuracy.run_all(accuracy.jobs_of(wanted), wanted):
            job = {"source": result["job"]["source"], "seed": result["job"]["seed"], "method": method}
            jobs.append({**job, **{name: result[name] for name in ("problem", "wall_s", "figures")}})
    return jobs


def measure(options: Options) -> dict[str, Any]:
    """Run the chosen experiments, each in a fresh process; return the figures by experiment."""
    figures: dict[str, Any] = {}
    if "pairs" in options.experiments:
        figures["pairs"] = alone(measure_pairs, accuracy.located(options.source), options)
    if "consistency" in options.experiments:
        figures["consistency"] = [alone(measure_consistency, room, options) for room in options.rooms]
    if "sequence" in options.experiments:
        figures["sequence"] = measure_sequences(options)
    return figures


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = replace(options, starts=min(options.starts, 3), limit=min(options.limit or 30, 30))
    name = Path(options.source).name
    return program.run("tracking", options, measure, options.seeds, not options.quick, source=name)


if __name__ == "__main__":
    program.start(main, Options)
