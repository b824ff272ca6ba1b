"""Run every preset on real frames with several submaps, small and with few iterations, and list what fails (issue 18).

Presets that cut submaps cut every 15 frames and try loops between all submaps, so that each stage runs: mapping,
tracking, cuts, loops, registration, final map, scores. The figures show that a preset works, not how good it is.
Writes benchmarks/results/every-preset-<machine>.json and prints a table for each sequence; exit code 1 if a run failed.
Finished runs are read, not repeated. --collect only reads what has ended, for instance while another process runs.

example: python benchmarks/every_preset.py --sources redkitchen --presets cgslam-loops-fast
"""

import sys
from dataclasses import dataclass, replace
from typing import Annotated, Any

import accuracy
import program
import tyro
from accuracy_tables import failures
from tables import Section, significant

from sigmasplat.config import Config
from sigmasplat.config.find_preset import list_presets, preset as preset_of, presets_by_scene
from sigmasplat.errors import SigmaSplatError
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
EVERY = (*list_presets(), *presets_by_scene())
SMALL = {"input.width": 160}
MOST = {
    "input.crop_px": 4, "mapping.every": 5, "mapping.first_iterations": 20, "mapping.iterations": 8,
    "tracking.iterations": 10, "registration.iterations": 6,
    "final.iterations": 40,
}  # fmt: skip
"""Settings that are lowered to these values where the preset has larger ones."""
CUT = {"submaps.frames": 15, "loops.min_interval": 2, "loops.near_m": 2.0}
"""Settings of presets that cut submaps."""


@dataclass(frozen=True)
class Options(accuracy.Options):
    """Run every preset on real frames with several submaps, small and with few iterations, and list what fails."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen",
        "livingroom",
    )
    presets: Annotated[tuple[str, ...], arg(help="presets to run")] = EVERY
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0,)
    limit: Annotated[int | None, arg(help="number of frames at most")] = 45
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "every-preset"
    collect: Annotated[bool, arg(help="run nothing; tabulate the runs that have ended")] = False


def shortened(config: Config) -> tuple[str, ...]:
    """Return the settings that make a run of a preset short, as of --set."""
    values = config.to_dict()
    lowered = {name: value for name, value in MOST.items() if _value(values, name) > value}
    rules = values["submaps"]
    cuts = any(rules[rule] for rule in ("distance_m", "frames", "uncertainty_m"))
    return tuple(f"{name}={value}" for name, value in (SMALL | lowered | (CUT if cuts else {})).items())


def _value(values: dict[str, Any], name: str) -> float:
    section, _, setting = name.partition(".")
    return float(values[section][setting])


def with_submaps(job: accuracy.Job, result: dict[str, Any], options: Options) -> dict[str, Any]:
    """Return a job's result with the numbers of submaps and loops, and the views that V is judged on."""
    if result["problem"]:
        return result
    metrics = RunFolder.open(job.folder(options.runs) / "run").read_metrics()
    loops, judged = metrics["loops"], metrics["uncertainty"] or {}
    counts = {"submaps": metrics["submaps"], "loops_tried": loops["tried"], "loops_closed": loops["accepted"]}
    return result | {"figures": result["figures"] | counts | {"judged_on": judged.get("judged_on")}}


# ---- tables ----


COLUMNS = (
    ("frames", "frames", 1.0),
    ("lost", "lost", 1.0),
    ("keyframes", "keyframes", 1.0),
    ("submaps", "submaps", 1.0),
    ("loops tried", "loops_tried", 1.0),
    ("… closed", "loops_closed", 1.0),
    ("splats, k", "splats", 1e-3),
    ("ATE, cm", "ate_m", 100.0),
    ("PSNR training, dB", "training_psnr_db", 1.0),
    ("Spearman V ~ error²", "spearman", 1.0),
)
"""Title, name of the figure, factor to the unit of the title."""
NOTE = (
    "One run each, 160 pixels wide, with few iterations: the figures show that a preset works, not how good it is. V "
    "is judged on held-out views, or on training views if the preset maps every frame."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table per sequence, and what failed."""
    results = measured["figures"]["jobs"]
    made = []
    for source in dict.fromkeys(result["job"]["source"] for result in results):
        runs = [r for r in results if r["job"]["source"] == source and r["problem"] is None]
        rows = [[run["job"]["preset"], *_cells(run["figures"])] for run in runs]
        head = ["preset", *(title for title, _, _ in COLUMNS), "V judged on"]
        made.append(Section(source, head, rows, NOTE))
    return [section for section in [*made, failures(results)] if section.rows]


def _cells(figures: dict[str, Any]) -> list[str]:
    numbers = [(figures.get(name), factor) for _, name, factor in COLUMNS]
    cells = ["–" if value is None else _written(factor * value) for value, factor in numbers]
    return [*cells, figures.get("judged_on") or "–"]


def _written(value: float) -> str:
    return f"{value:.0f}" if float(value).is_integer() else significant(value)


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 1 if a run failed, 2 if the options are invalid."""
    try:
        named = {name: shortened(preset_of(name)) for name in options.presets}
        jobs = accuracy.jobs_of(options)
        jobs = [replace(job, settings=(*named[job.preset], *job.settings)) for job in jobs]
        for job in jobs:
            job.key()
    except SigmaSplatError as problem:
        return program.refuse("every_preset", problem)
    if options.collect:
        results: list[dict[str, Any] | None] = [accuracy.ended(job, options.runs) for job in jobs]
        count = sum(result is not None for result in results)
        print(f"{count} of {len(jobs)} runs have ended in {options.runs}", file=sys.stderr)
    else:
        results = list(accuracy.run_all(jobs, options))
    found = [with_submaps(job, result, options) for job, result in zip(jobs, results, strict=True) if result]
    return accuracy.publish("every_preset", found, options)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
