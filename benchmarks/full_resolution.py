"""Compare final maps with and without the last stage of refinement, which uses images of the camera's own size.

Sequences × seeds; each is run twice, with `final.width` 0 and as by default. Held-out views are scored at working size,
of the submaps too, and at the camera's size, in the exposure of their frames, as metrics.json has them. The map without
the stage is scored twice at the camera's size: rendered there, and with its working images enlarged (bicubic). Writes
benchmarks/results/<name>-<machine>.json and prints a table.

example: python benchmarks/full_resolution.py --sources livingroom --seeds 0
"""

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import torch
import tyro
from accuracy_tables import spread
from numpy.typing import NDArray
from tables import Section

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.env import opencv
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer, Render
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
COLUMNS = {
    "submaps": "working size, submaps", "working_before": "before", "working_after": "after",
    "depth_before_cm": "depth L1, cm, before", "depth_after_cm": "after", "rendered_before": "camera's size, before",
    "enlarged_before": "before, enlarged", "after": "after", "gain": "gain over enlarged",
    "finish_before_s": "final map, s, before", "finish_s": "after",
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Compare final maps with and without the last stage of refinement, on images of the camera's size."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "fr1_xyz", "redkitchen", "livingroom", "cubicles", "hololens",
    )  # fmt: skip
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, two runs for each")] = (0, 1, 2)
    limit: Annotated[int, arg(help="use at most this many frames; 0 = all")] = 0
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "full-resolution"
    runs: Annotated[Path, arg(help="folder of the runs; they are deleted after they are scored")] = (
        accuracy.RUNS / "full-resolution"
    )
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


class Enlarged:
    """Renders working images and enlarges their colour (bicubic) to the size that is asked for."""

    def __init__(self, config: Config) -> None:
        self.renderer, self.width = FieldRenderer(config.render, config.backend), config.input.width

    def __call__(self, field: GaussianField, camera: Camera, T_camera_world: NDArray[np.float64]) -> Render:
        """Render a view; the other planes are those of the large image."""
        large = self.renderer(field, camera, T_camera_world)
        if camera.width <= self.width:
            return large
        cv2, small = opencv(), self.renderer(field, camera.prepared(self.width), T_camera_world).color.numpy()
        color = cv2.resize(small, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
        return replace(large, color=torch.from_numpy(np.asarray(color)))


def finished_run(source: str, seed: int, width: int, options: Options) -> RunFolder:
    """Run SLAM with a size of the last stage. Raises SigmaSplatError if the run fails."""
    folder = options.runs / f"{record.slug(Path(source).name)}-{seed}-{width}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "sigmasplat.cli", "run", accuracy.located(source), "--seed", str(seed)]
    words += ["--set", f"final.width={width}", "--out", str(folder), "--overwrite"]
    words += ["--limit", str(options.limit)] if options.limit else []
    words += [word for setting in options.settings for word in ("--set", setting)]
    problem, _ = accuracy.call(words, folder.with_suffix(".log"))
    if problem is not None:
        raise SigmaSplatError(f"{source}: the run with final.width={width} failed: {problem}")
    return RunFolder.open(folder)


def held_out_db(metrics: dict[str, Any]) -> float:
    """Return the mean PSNR of held-out views, dB."""
    return float(metrics["held_out"]["psnr_db"])


def measured(source: str, seed: int, options: Options) -> dict[str, Any]:
    """Run and score both maps of a sequence; return PSNR of held-out views, dB, and seconds of the final map. Raises
    SigmaSplatError if its images are not larger than working images."""
    recorded, working = open_source(accuracy.located(source)).camera.width, preset(default_preset()).input.width
    if recorded <= working:
        raise SigmaSplatError(f"{source}: images are {recorded} pixels wide; give images wider than {working} pixels")
    before, after = (finished_run(source, seed, width, options) for width in (0, preset(default_preset()).final.width))
    known = open_source(accuracy.located(source), before.config().input)
    rendered = evaluate(before, known, full_resolution=True)
    enlarged = evaluate(before, known, renderer=Enlarged(before.config()), full_resolution=True)
    refined = after.read_metrics()
    figures = {
        "submaps": refined["held_out_submaps"]["psnr_db"],
        "working_before": held_out_db(rendered), "working_after": held_out_db(refined),
        "depth_before_cm": 100 * rendered["held_out"]["depth_l1_m"],
        "depth_after_cm": 100 * refined["held_out"]["depth_l1_m"],
        "rendered_before": held_out_db(rendered["full_resolution"]),
        "enlarged_before": held_out_db(enlarged["full_resolution"]),
        "after": held_out_db(refined["full_resolution"]),
        "finish_before_s": rendered["finish_s"], "finish_s": refined["finish_s"],
    }  # fmt: skip
    for run in (before, after):
        shutil.rmtree(run.path)
    print(f"{source}, seed {seed}: {figures}", file=sys.stderr, flush=True)
    return {"source": Path(source).name, "seed": seed, "gain": figures["after"] - figures["enlarged_before"]} | figures


def measure(options: Options) -> dict[str, Any]:
    """Measure every sequence and seed."""
    return {"runs": [measured(source, seed, options) for source in options.sources for seed in options.seeds]}


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return a table with a row per sequence: mean ± standard deviation over the seeds."""
    runs = measured["figures"]["runs"]
    rows = [
        [source, *(spread([run[name] for run in runs if run["source"] == source and run.get(name) is not None])
                   for name in COLUMNS)]
        for source in dict.fromkeys(run["source"] for run in runs)
    ]  # fmt: skip
    note = "PSNR of held-out views, dB. Before: without the last stage. Final map: with it."
    return [Section("The camera's size", ["sequence", *COLUMNS.values()], rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them."""
    return program.run("full_resolution", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
