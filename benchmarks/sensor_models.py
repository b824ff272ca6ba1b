"""Measure what a sensor's model of depth noise is worth: path and rendered depth, with each of its uses alone.

Every run is made in this process on the same decoded frames; there is no refinement of the final map. Depth is that of
the merged map at the poses found, compared with the readings (exact in the living room), as `depth_l1_m` of
metrics.json.
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
from sigmasplat.config.text import override, split_settings
from sigmasplat.metrics.trajectory import ate
from sigmasplat.model import se3
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, preset
from sigmasplat.render import FieldRenderer
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import open_source

arg = tyro.conf.arg
USES = ("tracking", "mapping", "seeding")
VIEWS = 24
OPAQUE = 0.5


@dataclass(frozen=True)
class Options:
    """Compare runs with and without a model of the sensor's noise."""

    sources: Annotated[
        tuple[str, ...], arg(help="sequences with their sensor and number of frames: NAME=SENSOR:FRAMES")
    ] = ("redkitchen=kinect-v1:150", "hololens=time-of-flight:120", "cubicles=kinect-v1:50", "livingroom=kinect-v1:100")
    variants: Annotated[tuple[str, ...], arg(help="uses of the model, joined by +; none = without it")] = (
        "none", *USES, "+".join(USES),
    )  # fmt: skip
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    width: Annotated[int, arg(help="width of the working images, pixels")] = 160
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ("final.iterations=0", "uncertainty.probes=0")
    name: Annotated[str, arg(help="name of the results")] = "sensor-models"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


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
    """Make every run."""
    runs = []
    for given in options.sources:
        name, _, rest = given.partition("=")
        sensor, _, count = rest.rpartition(":")
        source = open_source(accuracy.located(name), limit=int(count))
        frames, truth = list(source), source.truth()
        assert truth is not None
        for seed in options.seeds:
            for uses in options.variants:
                found = measure_run(frames, truth, sensor, uses, seed, options)
                runs.append({"source": name, "sensor": sensor} | found)
                print(runs[-1], flush=True)
    return {"runs": runs}


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
    return [Section("Models of depth noise", columns, rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("sensor_models", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
