"""Run the presets of both papers with their own numbers of iterations on real frames with several submaps (issue 18).

Nothing is shortened: tracking, mapping, registration and the final map take all their steps. The images are 320 pixels
wide, those of light presets 160, and the pixels cropped at each edge are scaled down too. Every 8th frame is held out.
`sigma`, the default, runs on the same frames. Writes benchmarks/results/paper-presets-<machine>.json and prints a table
for each sequence; exit code 1 if a run failed.

example: python benchmarks/paper_presets.py --sources redkitchen --presets cgslam-tum sigma
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import accuracy
import program
import tyro
from accuracy_tables import failures, spread, values_of
from every_preset import with_submaps
from tables import Section

from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import split_settings
from sigmasplat.errors import SigmaSplatError
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
PAPERS = (
    "varsplat-tum", "varsplat-replica", "varsplat-released-fr1-desk", "varsplat-released-room0",
    "cgslam-tum", "cgslam-replica", "cgslam-light-tum", "cgslam-light-replica",
    "cgslam-released-fr1-desk", "cgslam-released-replica", "cgslam-loops-tum",
    "loopsplat-tum", "sigma",
)  # fmt: skip
WIDTH_PX = 320
CAMERA_WIDTH_PX = 640
"""Width of the images of both sequences, to which the presets' cropped pixels refer."""
HOLD_OUT = 8
LIGHT = "-light-"


@dataclass(frozen=True)
class Options(accuracy.Options):
    """Run the presets of both papers with their own numbers of iterations on real frames with several submaps."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen",
        "fr1_xyz",
    )
    presets: Annotated[tuple[str, ...], arg(help="presets to run")] = PAPERS
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0,)
    limit: Annotated[int | None, arg(help="number of frames at most")] = 120
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "paper-presets"


def sized(preset: str) -> tuple[str, ...]:
    """Return the settings that a run of a preset differs in, as of --set: size, scaled crop, held-out frames.

    A light preset is another one at half the size, and nothing else.
    """
    width_px = WIDTH_PX // 2 if LIGHT in preset else WIDTH_PX
    crop_px = preset_of(preset).input.crop_px * WIDTH_PX // CAMERA_WIDTH_PX
    return (f"input.width={width_px}", f"input.crop_px={crop_px}", f"input.hold_every={HOLD_OUT}")


def with_times(job: accuracy.Job, result: dict[str, Any], options: Options) -> dict[str, Any]:
    """Return a job's result with submaps, loops, PSNR of the submaps, and seconds per frame and of the final map."""
    result = with_submaps(job, result, options)
    if result["problem"]:
        return result
    metrics = RunFolder.open(job.folder(options.runs) / "run").read_metrics()
    submaps = metrics["held_out_submaps"] or metrics["held_out"] or {}
    more = {
        "frame_s": 1.0 / metrics["frames_per_s"], "finish_s": metrics["finish_s"],
        "submaps_psnr_db": submaps.get("psnr_db"),
        "all_frame_s": metrics["total_s"] / metrics["frames"], "silent": (metrics["failures"] or {}).get("silent"),
    }  # fmt: skip
    return result | {"figures": result["figures"] | more}


def width_of(result: dict[str, Any]) -> int:
    """Return how wide the images of a run were, pixels."""
    return int(split_settings(result["job"]["settings"])["input.width"])


COLUMNS = (
    ("lost", "lost", 1.0),
    ("silently off", "silent", 1.0),
    ("submaps", "submaps", 1.0),
    ("loops closed", "loops_closed", 1.0),
    ("splats, k", "splats", 1e-3),
    ("ATE, cm", "ate_m", 100.0),
    ("PSNR held-out, dB", "held_out_psnr_db", 1.0),
    ("… of the submaps", "submaps_psnr_db", 1.0),
    ("depth L1 held-out, cm", "held_out_depth_l1_m", 100.0),
    ("s per frame", "frame_s", 1.0),
    ("final map, s", "finish_s", 1.0),
    ("s per frame, with the final map", "all_frame_s", 1.0),
)
"""Title, name of the figure, factor to the unit of the title."""
NOTE = (
    "Numbers of iterations as in the preset, {width} pixels wide, NetVLAD's place taken by the built-in descriptor. "
    "Each process has one core. The presets were tuned on other recordings, at full size."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table per sequence, and what failed."""
    results = measured["figures"]["jobs"]
    made = []
    for source in dict.fromkeys(result["job"]["source"] for result in results):
        runs = [r for r in results if r["job"]["source"] == source and r["problem"] is None]
        rows, widest = [], max((width_of(run) for run in runs), default=0)
        for name in dict.fromkeys(run["job"]["preset"] for run in runs):
            same = [run for run in runs if run["job"]["preset"] == name]
            full_size = LIGHT in name and any(width_of(run) == widest for run in same)
            rows.append(
                [
                    f"{name} (not light: full size)" if full_size else name,
                    *(spread([k * v for v in values_of(same, figure)]) for _, figure, k in COLUMNS),
                ]
            )
        frames = int(runs[0]["figures"]["frames"]) if runs else 0
        said = f"{frames} frames. {NOTE.format(width=widest)}"
        made.append(Section(source, ["preset", *(title for title, _, _ in COLUMNS)], rows, said))
    return [section for section in [*made, failures(results)] if section.rows]


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 1 if a run failed, 2 if the options are invalid."""
    try:
        named = {name: sized(name) for name in options.presets}
        jobs = [replace(job, settings=(*named[job.preset], *job.settings)) for job in accuracy.jobs_of(options)]
    except SigmaSplatError as problem:
        return program.refuse("paper_presets", problem)
    results = accuracy.run_all(jobs, options)
    found = [with_times(job, result, options) for job, result in zip(jobs, results, strict=True)]
    return accuracy.publish("paper_presets", found, options)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
