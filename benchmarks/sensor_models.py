"""Measure what a sensor's model of depth noise is worth: path and rendered depth of whole runs, with its uses.

Runs are those of `sigmasplat run`, with the final map; depth is that of held-out views against their readings (exact in
the living room). Before that, pairs of frames are aligned alone, from a guess 1.7 cm and 0.5° off, and compared with
the true motion.
Writes benchmarks/results/sensor-models-<machine>.json and prints tables.

example: python benchmarks/sensor_models.py --sources redkitchen=kinect-v1 --seeds 0
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from tables import Section, significant

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.input import sensor_model
from sigmasplat.data import se3
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import confidence_of, relative_noise
from sigmasplat.fit.target import gray_of
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.sources import open_source
from sigmasplat.tracking.depth_filters import denoised

arg = tyro.conf.arg
PAIR_M, PAIR_WIDTH, PAIR_RANGE_M = 0.06, 320, (0.1, 8.0)
"""Pairs are about as far apart as a frame and its keyframe."""
GUESS_OFF = np.array([0.01, -0.01, 0.01, 0.005, -0.005, 0.005])
PAIR_COLUMNS = (
    "sequence (sensor)", "frames apart", "law, mm", "model, mm", "law, °", "model, °", "better", "better, °",
)  # fmt: skip
PAIR_NOTE = "Medians over the pairs; better: the share of pairs with a smaller error of position, and of rotation."
FIGURES = {
    "ATE, cm": ("ate_m", 100.0),
    "depth L1, mm": ("held_out_depth_l1_m", 1000.0),
    "PSNR, dB": ("held_out_psnr_db", 1.0),
}
"""Columns of the table: the figure of a run, and its factor."""


@dataclass(frozen=True)
class Options:
    """Compare runs with and without a model of the sensor's noise."""

    sources: Annotated[tuple[str, ...], arg(help="sequences with their sensor: NAME=SENSOR")] = (
        "redkitchen=kinect-v1", "hololens=time-of-flight", "cubicles=kinect-v1", "livingroom=kinect-v1",
    )  # fmt: skip
    variants: Annotated[tuple[str, ...], arg(help="none = without the model; tracking")] = (
        "none", "tracking",
    )  # fmt: skip
    pairs: Annotated[int, arg(help="pairs of frames that are aligned")] = 60
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    limit: Annotated[int | None, arg(help="number of frames at most", help_behavior_hint="(default: all)")] = None
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "sensor-models"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure_pairs(source: Source, sensor: str, count: int, weight_color: float) -> dict[str, Any]:
    """Align pairs of frames of a recording; return the errors of the motion with and without the model."""
    model, truth, errors = sensor_model(sensor), source.truth(), []
    assert model is not None and truth is not None
    gap_m = np.median(np.linalg.norm(np.diff(truth.T_world_camera[:, :3, 3], axis=0), axis=1))
    gap = max(1, round(PAIR_M / gap_m))
    for i in np.linspace(0, len(source) - 1 - gap, count).astype(int):
        pair = [source.frame(int(k)).prepared(PAIR_WIDTH, *PAIR_RANGE_M) for k in (i, i + gap)]
        depths, grays = [denoised(frame.depth_m) for frame in pair], [gray_of(frame.color) for frame in pair]
        live, camera = Pyramid.of(grays[1], depths[1], pair[1].camera), pair[0].camera
        rows = associate(np.array([frame.timestamp_s for frame in pair]), truth.timestamps_s)[1]
        true = se3.inverse(truth.T_world_camera[rows[1]]) @ truth.T_world_camera[rows[0]]
        plain, guess = Pyramid.of(grays[0], depths[0], camera), true @ se3.exp(GUESS_OFF)
        noise, confidence = relative_noise(depths[0], model), confidence_of(model)
        for reference in (plain, Pyramid.of(grays[0], depths[0], camera, noise=noise, confidence=confidence)):
            off = se3.inverse(true) @ align(reference, live, guess, weight_color=weight_color).T_live_reference
            errors.append((1000 * np.linalg.norm(off[:3, 3]), np.rad2deg(se3.rotation_angle(off[:3, :3]))))
    found = np.array(errors).reshape(-1, 2, 2)
    medians, better = np.median(found, 0), (found[:, 1] < found[:, 0]).mean(0)
    return {
        "gap": gap, "pairs": len(found), "without_mm": medians[0, 0], "with_mm": medians[1, 0],
        "without_deg": medians[0, 1], "with_deg": medians[1, 1], "better": better.tolist(),
    }  # fmt: skip


def jobs_of(options: Options) -> list[tuple[str, str, accuracy.Job]]:
    """Return sensor, variant and job of each run; those with and without the model take turns."""
    code, jobs = code_digest(Path(sigmasplat.__file__).parent, INSTALLED), []
    for name, sensor in (given.split("=", 1) for given in options.sources):
        for seed in options.seeds:
            for variant in options.variants:
                settings = (f"input.sensor={'generic' if variant == 'none' else sensor}", *options.settings)
                where = Path(name).name, accuracy.located(name)
                jobs.append(
                    (sensor, variant, accuracy.Job(*where, options.preset, seed, settings, options.limit, code))
                )
    return jobs


def measure(options: Options) -> dict[str, Any]:
    """Align every pair, and make every run."""
    runs, pairs, jobs = [], [], jobs_of(options)
    weight_color = preset(options.preset).tracking.align_weight_color
    for name, sensor in (given.split("=", 1) for given in options.sources):
        found = measure_pairs(open_source(accuracy.located(name)), sensor, options.pairs, weight_color)
        pairs.append({"source": name, "sensor": sensor} | found)
        print(pairs[-1], flush=True)
    for number, (sensor, variant, job) in enumerate(jobs, 1):
        result = accuracy.run_one(job, f"{number}/{len(jobs)}", options.runs, options.fresh)
        made = {"source": job.source, "sensor": sensor, "variant": variant, "seed": job.seed}
        runs.append(made | {"problem": result["problem"]} | result["figures"])
    return {"pairs": pairs, "runs": runs}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the mean of each sequence and variant over the seeds, and its change against the run without a model."""
    runs, rows = [r for r in measured["figures"]["runs"] if r["problem"] is None], []
    for source in dict.fromkeys(r["source"] for r in runs):
        for variant in dict.fromkeys(r["variant"] for r in runs):
            of = {v: [r for r in runs if r["source"] == source and r["variant"] == v] for v in ("none", variant)}
            if not of["none"] or not of[variant]:
                continue
            row = [f"{source} ({of[variant][0]['sensor']})", variant]
            for key, factor in FIGURES.values():
                before, after = (factor * np.array([r[key] for r in of[v]]) for v in ("none", variant))
                relative = f"{100 * (after.mean() / before.mean() - 1):+.1f} %"
                change = f"{after.mean() - before.mean():+.2f}" if factor == 1.0 else relative
                mean = f"{significant(float(after.mean()))} ± {significant(float(after.std()))}"
                row.append(mean if variant == "none" else f"{mean} ({change})")
            rows.append([*row, str(sum(r["lost"] for r in of[variant]))])
    note = "Mean ± standard deviation over the seeds, and the change of the mean. "
    note += "The living room has exact depth, so its model is wrong on purpose."
    columns = ("sequence (sensor)", "uses of the model", *FIGURES, "lost frames")
    aligned = [
        [f"{p['source']} ({p['sensor']})", str(p["gap"]), *(f"{p[key]:.2f}" for key in ("without_mm", "with_mm")),
         *(f"{p[key]:.3f}" for key in ("without_deg", "with_deg")), *(f"{100 * share:.0f} %" for share in p["better"])]
        for p in measured["figures"]["pairs"]
    ]  # fmt: skip
    return [
        Section(
            "Alignment of two frames", PAIR_COLUMNS, aligned, 'Medians over the pairs; "better" is the share of pairs.'
        ),
        Section("Models of depth noise", columns, rows, note),
    ]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("sensor_models", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
