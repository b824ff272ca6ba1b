"""Measure the effect of each path of the pose gradient on pose accuracy and time (CG-SLAM §2.1).

sequence: complete sequences tracked by Adam through the renderer, without and with the path through the 2D covariance.
localise: single frames localised in a map with spherical harmonics, without and with that path.
Writes benchmarks/results/pose-gradient-<machine>.json, prints tables; benchmarks/README.md explains each figure.

example: python benchmarks/pose_gradient.py --experiments localise --sources livingroom
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import accuracy
import numpy as np
import program
import record
import tracking
import tyro
from accuracy_tables import PLACE, failed_runs, spread, values_of
from cpu import alone
from localise import WAYS, Search, disturbed, localise, shares, view_dependence
from numpy.typing import NDArray
from tables import Section, significant

from sigmasplat.config import Config, FinalConfig
from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.harmonics import DEGREES
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
Experiment = Literal["sequence", "localise"]
RATES = {**tracking.RATES, "CG-SLAM": (7.5e-4, 2.15e-3)}
"""Learning rates of tracking by Adam: quaternion, which rotates by twice as much, and translation. CG-SLAM: 1.5e-3."""
ONE_MAP = ("submaps.distance_m=0", "submaps.frames=0", "submaps.uncertainty_m=0")
SEEDS_PER_PIXEL = (0.5, 0.2)
"""In the first frame, drawn uniformly and by gradient; the same density as varsplat-fast at its own width."""


@dataclass(frozen=True)
class Options:
    """Measure the effect of each path of the pose gradient on pose accuracy and time."""

    experiments: Annotated[tuple[Experiment, ...], arg(help="which ones to run")] = ("sequence", "localise")
    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "synthetic:frames=400,width=160,height=120",
        "livingroom",
        "redkitchen",
    )
    limit: Annotated[int, arg(help="number of frames, from the start of each sequence")] = 80
    width: Annotated[int, arg(help="working width, pixels")] = 160
    preset: Annotated[str, arg(help="preset to start from")] = "varsplat-fast"
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run or map for each")] = (0, 1)
    iterations: Annotated[int, arg(help="Adam iterations per tracked frame")] = 30
    rates: Annotated[
        Literal["Replica", "TUM", "CG-SLAM"], arg(help="system whose learning rates Adam uses in tracking")
    ] = "CG-SLAM"
    refinement: Annotated[int, arg(help="refinement steps of the map, including harmonics")] = 1000
    degree: Annotated[int, arg(help="degree of the harmonics, 1 to 3")] = 2
    frames: Annotated[int, arg(help="held-out frames to localise in each map")] = 8
    steps: Annotated[int, arg(help="Adam steps per localised frame, while learning rates fall to 0")] = 60
    off_m: Annotated[float, arg(help="initial position error, metres")] = 0.02
    off_deg: Annotated[float, arg(help="initial rotation error, degrees")] = 1.0
    weight_color: Annotated[float, arg(help="share of colour in the loss")] = 0.6
    quick: Annotated[bool, arg(help="a minute: one short sequence, one seed, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "pose-gradient"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def map_settings(self) -> tuple[str, ...]:
        """Return the settings for maps of this width: one submap, as dense as with the preset."""
        uniform, gradient = (int(share * self.width**2 * 0.75) for share in SEEDS_PER_PIXEL)
        seeds = (f"seeding.first_uniform={uniform}", f"seeding.first_gradient={gradient}")
        return (f"input.width={self.width}", *seeds, *ONE_MAP, "loops.close=false")

    def tracking_settings(self, way: str) -> tuple[str, ...]:
        """Return the settings of a complete sequence tracked by Adam."""
        rotation, translation = RATES[self.rates]
        return (
            *self.map_settings(), "final.iterations=0", "tracking.method=adam",
            f"tracking.iterations={self.iterations}", f"tracking.lr_rotation={rotation}",
            f"tracking.lr_translation={translation}",
            f"render.covariance_pose_gradient={str(WAYS[way].covariance_pose_gradient).lower()}",
        )  # fmt: skip

    def map_config(self, seed: int) -> Config:
        """Return the settings of a map with harmonics. Raises ConfigError for an unknown preset or degree."""
        if not 1 <= self.degree <= DEGREES:
            raise ConfigError(f"--degree of the harmonics must be 1 to {DEGREES}, found {self.degree}")
        final = (f"final.iterations={self.refinement}", f"final.sh_degree={self.degree}")
        settings = split_settings((*self.map_settings(), *final)) | {"seed": str(seed)}
        config = override(preset_of(self.preset), settings)
        gaining = type("Gaining", (FinalConfig,), {"sh_every": max(1, self.refinement // 10)})
        return replace(config, final=gaining(**vars(config.final)))

    def search(self) -> Search:
        """Return the settings for localising single frames."""
        return Search(self.off_m, self.off_deg, self.steps, self.weight_color)


# ---- whole sequences ----


def measure_sequences(options: Options) -> list[dict[str, Any]]:
    """Run complete sequences without and with the covariance path; a run that failed has a `problem`."""
    found = []
    for way in WAYS:
        wanted = accuracy.Options(
            options.sources, (options.preset,), options.seeds, options.tracking_settings(way), options.limit,
            fresh=options.fresh, runs=options.runs,
        )  # fmt: skip
        jobs = accuracy.jobs_of(wanted)
        for job, result in zip(jobs, accuracy.run_all(jobs, wanted), strict=True):
            made = {"source": job.source, "seed": job.seed, "way": way}
            made |= {name: result[name] for name in ("problem", "wall_s", "figures")}
            if result["problem"] is None:
                log = RunFolder.open(job.folder(options.runs) / "run").read_log()
                made["figures"] = result["figures"] | {"ms_per_iteration": iteration_ms(log)}
            found.append(made)
    return found


def iteration_ms(log: Sequence[dict[str, Any]]) -> float | None:
    """Return the median over a run's frames of tracking time per iteration, ms; None if no frame was tracked.

    A frame tracked twice has the time of both tries and the iterations of one; the median ignores such outliers.
    """
    tracked = [line for line in log if (line.get("tracking") or {}).get("iterations")]
    times = [1e3 * line["seconds"]["track"] / line["tracking"]["iterations"] for line in tracked]
    return float(np.median(times)) if times else None


# ---- single frames ----


def measure_localise(path: str, options: Options, seed: int) -> dict[str, Any]:
    """Map a sequence with harmonics; localise held-out frames in it by every variant from the same start.

    Raises SourceError if no frame is held out, or without ground truth.
    """
    source, slam = open_source(path, limit=options.limit), Slam(options.map_config(seed))
    for frame in source:
        slam.step(frame)
    slam.finish()
    estimated, views = slam.trajectory().T_world_camera, held_out(slam, options.frames)
    truth = tracking.true_poses(source, [step.timestamp_s for step in slam.steps])
    if not views:
        raise SourceError(f"{path}: no tracked frame is held out; use a larger --limit")
    random, found = np.random.default_rng(seed), list[dict[str, Any]]()
    changes, parts = list[float](), list[dict[str, list[float]]]()
    for row, keyframe in views:
        i, tracked = slam.config.input, se3.inverse(estimated[row])
        frame = source.frame(slam.steps[row].index).prepared(i.width, i.min_depth_m, i.max_depth_m)
        changes.append(view_dependence(slam.field, frame, tracked))
        poses = found_poses(slam.field, frame, tracked, options.search(), random)
        parts.append(shares(slam.field, frame, poses["start"][0], options.search()))
        for way, (T, ms) in poses.items():
            motion = se3.inverse(estimated[keyframe]) @ se3.inverse(T)
            error = tracking.relative_error(motion, se3.inverse(truth[keyframe]) @ truth[row])
            found.append({"frame": frame.index, "way": way, "ms": round(ms, 3), **error})
    figures = {"splats": len(slam.field), "view_dependence": float(np.mean(changes))}
    return {"seed": seed, **figures, "shares": parts, "found": found}


def found_poses(
    field: GaussianField, frame: Frame, tracked: Matrix, search: Search, random: np.random.Generator
) -> dict[str, tuple[Matrix, float]]:
    """Return T_camera_world as tracked, as disturbed, and as found by each variant from there, with its ms per step."""
    start = disturbed(tracked, search, random)
    poses = {"as tracked": (tracked, 0.0), "start": (start, 0.0)}
    return poses | {way: localise(field, frame, start, switches, search) for way, switches in WAYS.items()}


def held_out(slam: Slam, count: int) -> list[tuple[int, int]]:
    """Choose evenly spread held-out frames: (row, row of the newest keyframe before it)."""
    pairs, keyframe = list[tuple[int, int]](), -1
    for row, step in enumerate(slam.steps):
        if step.is_keyframe:
            keyframe = row
        elif keyframe >= 0 and not step.lost:
            pairs.append((row, keyframe))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(count, len(pairs))).round().astype(int))
    return [pairs[i] for i in chosen]


# ---- program ----


def shortened(options: Options) -> Options:
    """Return the options for --quick."""
    few = {"limit": min(options.limit, 24), "refinement": min(options.refinement, 60), "frames": min(options.frames, 3)}
    return replace(options, sources=options.sources[:1], seeds=options.seeds[:1], **few)


def measure(options: Options) -> dict[str, Any]:
    """Run the chosen experiments; maps are made in fresh processes. Raises SigmaSplatError."""
    options.map_config(0)
    figures: dict[str, Any] = {}
    if "sequence" in options.experiments:
        figures["sequence"] = measure_sequences(options)
    if "localise" in options.experiments:
        figures["localise"] = []
        for source in options.sources:
            maps = []
            for seed in options.seeds:
                maps.append(alone(measure_localise, accuracy.located(source), options, seed))
                print(f"{Path(source).name}, seed {seed}: frames localised", file=sys.stderr, flush=True)
            figures["localise"].append({"source": Path(source).name, "maps": maps})
    return figures


# ---- tables ----


Rows = list[dict[str, Any]]
RUN = (*(figure for figure in PLACE if figure[1] in ("ate_m", "rpe_m", "rpe_deg", "lost")),
       ("ms per iteration", "ms_per_iteration", 1.0))  # fmt: skip
"""Title, name of the figure, factor to the unit of the title."""
ERRORS = ("translation_cm", "rotation_deg")
FIRST = ("without covariance", "mean + depth")
"""Names of the variant that the others are compared with: today's, and that of earlier results."""


def sequences(jobs: Rows) -> Section:
    """Tabulate complete runs by sequence and variant."""
    rows = []
    for source, way in dict.fromkeys((job["source"], job["way"]) for job in jobs):
        done = [job for job in jobs if (job["source"], job["way"], job["problem"]) == (source, way, None)]
        cells = [spread([factor * value for value in values_of(done, name)]) for _, name, factor in RUN]
        rows.append([source, way, str(len(done)), *cells])
    head = ["sequence", "paths", "runs", *(title for title, _, _ in RUN)]
    rows.sort(key=lambda row: [job["source"] for job in jobs].index(row[0]))
    return Section("Sequences", head, rows, "Mean ± standard deviation over the seeds.")


def pairs_of(maps: Rows, way: str, figure: str) -> tuple[list[float], list[float]]:
    """Return a figure of every frame by a variant, and of the same frames by the first variant."""
    ours, firsts = ([f[figure] for m in maps for f in m["found"] if f["way"] in w] for w in ((way,), FIRST))
    return ours, firsts


def localisation(measured: Rows) -> Section:
    """Tabulate the errors of single frames: medians over frames and seeds, and the share of frames that improve."""
    rows = []
    for source in measured:
        maps = source["maps"]
        for way in dict.fromkeys(found["way"] for found in maps[0]["found"]):
            cells = [str(len(pairs_of(maps, way, "ms")[0]))]
            fitted = bool(max(pairs_of(maps, way, "ms")[0]))
            for error in ERRORS:
                ours, firsts = pairs_of(maps, way, error)
                nearer = 100.0 * float(np.mean(np.less(ours, firsts))) if fitted and way not in FIRST else None
                cells += [significant(float(np.median(ours))), significant(nearer, 2)]
            cells.append(significant(float(np.median(pairs_of(maps, way, "ms")[0])) if fitted else None))
            rows.append([source["source"], way, *cells])
    head = ["sequence", "paths", "frames", "cm, median", "better, %", "°, median", "better, %", "ms per iteration"]
    note = "Better: share of frames with a smaller error than without the path through the covariance. "
    return Section("Localisation", head, rows, note + harmonics_of(measured))


def paths(measured: Rows) -> Section:
    """Tabulate the size of each path's gradient at the start of the search."""
    rows = []
    for source in measured:
        found = [part for m in source["maps"] for part in m["shares"]]
        for path in found[0]:
            medians = np.median([part[path] for part in found], 0)
            rows.append([source["source"], path, *(significant(100.0 * float(share)) for share in medians)])
    head = ["sequence", "path", "share of the gradient by ρ, %", "… by φ, %"]
    return Section(
        "Paths", head, rows, "Norm relative to that of all paths together, median. Paths can have opposite signs."
    )


def harmonics_of(measured: Rows) -> str:
    """Write how much the maps' colours depend on the viewing direction."""
    shares = [f"{s['source']} {np.mean([m['view_dependence'] for m in s['maps']]):.4f}" for s in measured]
    return f"Mean absolute change of colour by harmonics: {', '.join(shares)}."


def failures(jobs: Rows) -> Section:
    """List the runs that failed, with the last line they printed."""
    return failed_runs(jobs, lambda job: f"{job['source']}, {job['way']}, seed {job['seed']}")


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by pose_gradient.py."""
    jobs, found = (measured["figures"].get(name, []) for name in ("sequence", "localise"))
    made = [sequences(jobs), localisation(found), paths(found), failures(jobs)]
    return [section for section in made if section.rows]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = shortened(options)
    return program.run("pose_gradient", options, measure, options.seeds, not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
