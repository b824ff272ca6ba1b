"""Measure what a sensor's model of depth noise is worth: path and rendered depth, with each of its uses alone.

Every run is made in this process on the same decoded frames; there is no refinement of the final map. Depth is that of
the merged map at the poses found, compared with the readings (exact in the living room), as `depth_l1_m` of
metrics.json. Before that, pairs of frames are aligned alone, from a guess 1.7 cm and 0.5° off, and compared with the
true motion.
Writes benchmarks/results/sensor-models-<machine>.json and prints tables.

example: python benchmarks/sensor_models.py --sources redkitchen=kinect-v1:60 --seeds 0
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config.sensors import sensor_model
from sigmasplat.config.text import override, split_settings
from sigmasplat.fit.align import align
from sigmasplat.fit.gray import gray_of
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import relative_noise
from sigmasplat.metrics.trajectory import associate, ate
from sigmasplat.model import se3
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, preset
from sigmasplat.render import FieldRenderer
from sigmasplat.slam.localisation.denoise import denoised
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import open_source
from sigmasplat.sources.base import Source

arg = tyro.conf.arg
USES = ("tracking", "mapping", "seeding")
PAIR_M, PAIR_WIDTH, PAIR_RANGE_M = 0.06, 320, (0.1, 8.0)
"""Pairs are about as far apart as a frame and its keyframe."""
GUESS_OFF = np.array([0.01, -0.01, 0.01, 0.005, -0.005, 0.005])
PAIR_COLUMNS = (
    "sequence (sensor)", "frames apart", "law, mm", "model, mm", "law, °", "model, °", "better", "better, °",
)  # fmt: skip
PAIR_NOTE = "Medians over the pairs; better: the share of pairs with a smaller error of position, and of rotation."
VIEWS = 24
OPAQUE = 0.5


@dataclass(frozen=True)
class Options:
    """Compare runs with and without a model of the sensor's noise."""

    sources: Annotated[
        tuple[str, ...], arg(help="sequences with their sensor and number of frames: NAME=SENSOR:FRAMES")
    ] = ("redkitchen=kinect-v1:80", "hololens=time-of-flight:40", "cubicles=kinect-v1:40", "livingroom=kinect-v1:50")
    variants: Annotated[tuple[str, ...], arg(help="uses of the model, joined by +; none = without it")] = (
        "none", *USES,
    )  # fmt: skip
    pairs: Annotated[int, arg(help="pairs of frames that are aligned")] = 60
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    width: Annotated[int, arg(help="width of the working images, pixels")] = 160
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("final.iterations=0", "uncertainty.probes=0")
    name: Annotated[str, arg(help="name of the results")] = "sensor-models"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure_pairs(source: Source, sensor: str, count: int) -> dict[str, Any]:
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
        for noise in (None, relative_noise(depths[0], model)):
            reference = Pyramid.of(grays[0], depths[0], camera, noise=noise)
            off = se3.inverse(true) @ align(reference, live, true @ se3.exp(GUESS_OFF)).T_live_reference
            errors.append((1000 * np.linalg.norm(off[:3, 3]), np.rad2deg(se3.rotation_angle(off[:3, :3]))))
    found = np.array(errors).reshape(-1, 2, 2)
    medians, better = np.median(found, 0), (found[:, 1] < found[:, 0]).mean(0)
    return {
        "gap": gap, "pairs": len(found), "without_mm": medians[0, 0], "with_mm": medians[1, 0],
        "without_deg": medians[0, 1], "with_deg": medians[1, 1], "better": better.tolist(),
    }  # fmt: skip


def measure_run(
    frames: list[Frame], truth: Trajectory, sensor: str, uses: str, seed: int, o: Options
) -> dict[str, Any]:
    """Make one run; return its path error and depth error, cm, and its lost frames and processor time."""
    chosen = [] if uses == "none" else [f"{use}.sensor_noise=true" for use in uses.split("+")]
    given = (f"seed={seed}", f"input.width={o.width}", f"input.sensor={sensor}", *o.settings, *chosen)
    slam, began = Slam(override(preset(o.preset), split_settings(given))), time.process_time()
    for frame in frames:
        slam.step(frame)
    slam.finish()
    seconds, path, believed = time.process_time() - began, slam.trajectory(), slam.believed()
    kept = Trajectory(path.timestamps_s[believed], path.T_world_camera[believed])
    render, errors = FieldRenderer(slam.config.render, slam.config.backend), []
    for i in np.linspace(0, len(frames) - 1, VIEWS).round().astype(int):
        working = frames[i].prepared(o.width, slam.config.input.min_depth_m, slam.config.input.max_depth_m)
        seen = render(slam.field, working.camera, se3.inverse(path.T_world_camera[i]))
        alpha = seen.alpha.numpy()
        valid = (alpha > OPAQUE) & (working.depth_m > 0)
        if believed[i] and valid.any():
            errors.append(float(np.abs(seen.depth.numpy() / np.maximum(alpha, OPAQUE) - working.depth_m)[valid].mean()))
    return {
        "variant": uses, "seed": seed, "ate_cm": 100 * ate(kept, truth).rmse_m, "lost": int((~believed).sum()),
        "depth_l1_cm": 100 * float(np.mean(errors)), "frames": len(frames), "processor_s": round(seconds, 1),
    }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Align every pair, and make every run."""
    runs, pairs = [], []
    for given in options.sources:
        name, _, rest = given.partition("=")
        sensor, _, count = rest.rpartition(":")
        pairs.append(
            {"source": name, "sensor": sensor}
            | measure_pairs(open_source(accuracy.located(name)), sensor, options.pairs)
        )
        print(pairs[-1], flush=True)
        source = open_source(accuracy.located(name), limit=int(count))
        frames, truth = list(source), source.truth()
        assert truth is not None
        for seed in options.seeds:
            for uses in options.variants:
                found = measure_run(frames, truth, sensor, uses, seed, options)
                runs.append({"source": name, "sensor": sensor} | found)
                print(runs[-1], flush=True)
    return {"pairs": pairs, "runs": runs}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the mean of each sequence and variant over the seeds, and its change against the run without a model."""
    runs, rows = measured["figures"]["runs"], []
    for source in dict.fromkeys(r["source"] for r in runs):
        for variant in dict.fromkeys(r["variant"] for r in runs):
            of = {v: [r for r in runs if r["source"] == source and r["variant"] == v] for v in ("none", variant)}
            row = [f"{source} ({of[variant][0]['sensor']})", variant]
            for key in ("ate_cm", "depth_l1_cm"):
                before, after = (np.array([r[key] for r in of[v]]) for v in ("none", variant))
                change = "" if variant == "none" else f" ({100 * (after.mean() / before.mean() - 1):+.1f} %)"
                row.append(f"{significant(float(after.mean()))} ± {significant(float(after.std()))}{change}")
            rows.append([*row, str(sum(r["lost"] for r in of[variant]))])
    note = "Mean ± standard deviation over the seeds, and the change of the mean. "
    note += "The living room has exact depth, so its model is wrong on purpose."
    columns = ("sequence (sensor)", "uses of the model", "ATE, cm", "depth L1, cm", "lost frames")
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
