"""Score how well predicted variances match the errors of views held back from the map, and of the surface, on six
sequences, beside simple baselines; score the covariance of poses and the probability of a wrong pose, too.

Frames are held back from the map (input.hold_every) and rendered afterwards. Temperatures come from other sequences.
Finished runs are kept in runs/bench/uncertainty/NAME and are not repeated while code and settings are unchanged.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes its tables into the documents.

example: python benchmarks/uncertainty.py --sources redkitchen livingroom --seeds 1 --limit 120 --set input.width=240
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import tyro
from ablation import short
from finished_run import run_slam
from tables import Section
from uncertainty_files import SCORES, StudyFolder
from uncertainty_samples import HELD_BACK, Job, Measured, Study, measure, study_config

from sigmasplat.commands import options as described
from sigmasplat.commands.input_options import Limit
from sigmasplat.commands.options import prepare_torch
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.ranges import Range
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.plugins.evaluation.path_scores import MOTIONS
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.figures import number
from sigmasplat.run.scene import open_scene
from sigmasplat.run.terminal import Screen

arg = tyro.conf.arg
DEFAULT_PRESET = default_preset()
ROOM = "synthetic:frames=240,noise=1,test_views=24,seed={seed}"
SYNTHETIC = {"synthetic": ROOM, "synthetic, steady exposure": f"{ROOM},exposure_change=0"}
"""A different room for each seed. The test views have exposure gain 1; the frames do only if the exposure is steady."""
SOURCES = (*SYNTHETIC, "livingroom", "redkitchen", "cubicles", "hololens")
RUNS = record.ROOT / "runs" / "bench" / "uncertainty"
FAILURES = "AUROC: how often p_off is higher for a frame that is off than for one that is not; ½ is random."
KEPT = (
    "ause",
    "spearman",
    "before",
    "after",
    "temperature",
    "after_68",
    "temperature_68",
    "best_scale",
    "nll_at_best_scale",
)
HoldEvery = Annotated[int, Range(2), arg(help="hold back every N-th frame from the map")]
MostViews = Annotated[int, Range(1), arg(help="largest number of views that are scored, of each kind")]


@dataclass(frozen=True)
class Options:
    """Score predicted variances at views held back from the map."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = SOURCES
    preset: described.PresetName = DEFAULT_PRESET
    settings: described.Settings = ()
    seeds: described.Runs = 3
    limit: Limit = None
    hold_every: HoldEvery = 8
    views: MostViews = 24
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "uncertainty"
    runs: Annotated[Path, arg(help="folder of finished runs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def folder(self) -> Path:
        """Return the folder of the samples."""
        return self.runs / record.slug(self.name)

    def study(self) -> Study:
        """Return what to measure. Raises ConfigError on invalid values."""
        if not self.sources:
            raise ConfigError("no source given; give --sources")
        config, given = study_config(self.preset, self.settings), tuple(split_settings(self.settings))
        sources = tuple(dict.fromkeys(map(located, self.sources)))
        return Study(sources, config, self.seeds, self.limit, self.hold_every, self.views, given)

    def run(self, screen: Screen) -> None:
        """Make the missing runs, and score all of them. Raises SigmaSplatError."""
        study = self.study()
        jobs, folder = study.jobs(), StudyFolder.create(self.folder(), study)
        for job in jobs:
            open_source(job.path, job.config.input)  # a wrong path fails now and not after hours
        prepare_torch()
        measured = []
        for place, job in enumerate(jobs, 1):
            found = folder.load(job)
            if found is None:
                screen.say(f"[{place}/{len(jobs)}] {job.source}, seed {job.seed}")
                found = run_job(job, study.views, screen)
                folder.save(job, found)
            if not found.facts["views"][HELD_BACK]:
                screen.warn(f"{job.source}, seed {job.seed}: no frame that was held back has a valid pose")
            measured.append(found)
        folder.write(jobs, measured)


def run_job(job: Job, views: int, screen: Screen) -> Measured:
    """Run SLAM with a job's settings and collect its samples."""
    source, config = open_scene(job.path, job.config, job.given)
    with screen.steps(len(source)) as show:
        run = run_slam(config, source, show)
    with screen.counting("views") as progress:
        return measure(run, source, views, progress=progress)


def located(name: str) -> str:
    """Return the path of a sequence in the data folder, or the name unchanged if it is not there."""
    known = record.data_root() / name
    return SYNTHETIC.get(name, str(known.resolve()) if known.is_dir() else name)


def kept(results: dict[str, Any]) -> dict[str, Any]:
    """Return the runs for the committed results: with names instead of paths, without reliability tables."""
    names, runs = {source: name for name, source in SYNTHETIC.items()}, []
    for run in results["runs"]:
        named = run | {
            "source": names.get(run["source"], short(run["source"])),
            "path": Path(run["path"]).name,
            "scores": _thinned(run["scores"]),
        }
        runs.append(named)
    return {"config": results["config"], "hold_every": results["hold_every"], "runs": runs}


def _thinned(scores: dict[str, Any]) -> dict[str, Any]:
    """Return scores of nested kinds with the values of `KEPT` only."""
    if "predictors" not in scores:
        return {name: _thinned(inner) for name, inner in scores.items()}
    rows = {name: {key: row[key] for key in KEPT} for name, row in scores["predictors"].items()}
    return {name: value for name, value in scores.items() if name != "predictors"} | {"predictors": rows}


# ---- tables ----


MANY = 100.0
"""A larger figure is shown without decimals."""


def pose_rows(runs: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return a row for each kind of motion that was scored: its name, and the cells of `POSE_COLUMNS`."""
    rows = []
    for kind, name in MOTIONS.items():
        scores = [run["poses"][kind] for run in runs if run.get("poses") and run["poses"][kind]]
        if scores:
            rows.append([name, *(written([value(row) for row in scores], n) for _, n, value in POSE_COLUMNS)])
    return rows


def failure_rows(runs: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return one row if the truth is known: the mean number of frames, and the cells of `FAILURE_COLUMNS`."""
    scores = [run["failures"] for run in runs if run.get("failures")]
    if not scores:
        return []
    frames = written([row["frames"] for row in scores], 0)
    return [[frames, *(written([value(row) for row in scores], digits) for _, digits, value in FAILURE_COLUMNS)]]


POSE_COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], Any]], ...] = (
    ("motions", 0, lambda row: row["count"]),
    ("NEES, mean", 2, lambda row: row["nees_mean"]),
    ("NEES, median", 2, lambda row: row["nees_median"]),
    ("in 90 %, %", 1, lambda row: _percent(row["coverage_90"])),
    ("position in 90 %, %", 1, lambda row: _percent(row["position_coverage_90"])),
    ("k of position", 2, lambda row: row["position_k"]),
)
FAILURE_COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], Any]], ...] = (
    ("off by > 5 cm", 0, lambda row: row["off"]),
    ("AUROC of p_off", 3, lambda row: row["auroc"]),
    ("Brier", 4, lambda row: row["brier"]),
)
COLUMNS: tuple[tuple[str, int, Callable[[dict[str, Any]], Any]], ...] = (
    ("NLL", 2, lambda row: row["before"]["nll"]),
    ("T", 2, lambda row: row["temperature"]),
    ("NLL after", 2, lambda row: row["after"]["nll"]),
    ("AUCE", 3, lambda row: row["before"]["auce"]),
    ("AUCE after", 3, lambda row: row["after"]["auce"]),
    ("68 % after", 0, lambda row: _percent(row["after"]["coverage_68"])),
    ("95 % after", 0, lambda row: _percent(row["after"]["coverage_95"])),
    ("AUSE", 2, lambda row: row["ause"]),
    ("Spearman", 2, lambda row: row["spearman"]),
)
"""Heads, digits and values of the columns."""


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def written(values: Sequence[float | None], digits: int) -> str:
    """Write the mean of the known values, ± their standard deviation if there are several."""
    known = [value for value in values if value is not None and value == value]
    if not known:
        return number(None, 0)
    mean = statistics.fmean(known)
    shown = number(mean, digits if abs(mean) < MANY else 0)
    return (
        shown if len(known) < 2 else f"{shown} ± {number(statistics.stdev(known), digits if abs(mean) < MANY else 0)}"
    )


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return a table per quantity, map, kind of views and subset of pixels: one row per sequence and predictor; then
    the tables of poses and failures."""
    runs = measured["figures"]["runs"]
    kinds = dict.fromkeys(
        (quantity, map_name, views, subset)
        for run in runs
        for quantity, maps in run["scores"].items()
        for map_name, found in maps.items()
        for views, subsets in found.items()
        for subset in subsets
    )
    coverage = coverage_table(runs)
    return [*([coverage] if coverage.rows else []), *(kind_table(runs, kind) for kind in kinds), *path_tables(runs)]


def coverage_table(runs: list[dict[str, Any]]) -> Section:
    """Tabulate the coverage of the predicted errors of the final map: one row per sequence and kind of views."""
    lines = list[list[str]]()
    views = dict.fromkeys(kind for run in runs for kind in run["scores"].get("color", {}).get("final", {}))
    for kind in views:
        for source in dict.fromkeys(run["source"] for run in runs):
            cells = list[str]()
            for quantity, subset in (("color", "all pixels"), ("depth", "covered pixels")):
                of_source = [run["scores"].get(quantity, {}) for run in runs if run["source"] == source]
                found = [of_run.get("final", {}).get(kind, {}).get(subset) for of_run in of_source]
                predictors = [scores["predictors"] for scores in found if scores]
                rows = [of["predictive"]["before"] for of in predictors if "predictive" in of]
                for key, digits, scale in (("coverage_68", 0, 100.0), ("coverage_95", 0, 100.0), ("auce", 3, 1.0)):
                    cells.append(written([scale * row[key] for row in rows], digits) if rows else "–")
            if set(cells) != {"–"}:
                lines.append([source, kind, *cells])
    head = [
        f"{name}: {what}" for name in ("colour", "depth") for what in ("within 1 std, %", "within 1.96 std, %", "AUCE")
    ]
    note = "Ideal: 68.3 % and 95 %; AUCE 0. Colour: all pixels; depth: where the map covers the pixel."
    return Section("Coverage of predicted errors, final map", ["sequence", "views", *head], lines, note)


def path_tables(runs: list[dict[str, Any]]) -> list[Section]:
    """Tabulate the scores of pose covariances and of `p_off`, if they were measured."""
    sources = {
        name: [run for run in runs if run["source"] == name] for name in dict.fromkeys(r["source"] for r in runs)
    }
    poses = [[name, *row] for name, of_source in sources.items() for row in pose_rows(of_source)]
    failures = [[name, *row] for name, of_source in sources.items() for row in failure_rows(of_source)]
    head = ["sequence", "motion", *(name for name, _, _ in POSE_COLUMNS)]
    note = "NEES should be 6 on average, k = 1 (the variances of the position are k times too small)."
    made = [
        Section("Poses", head, poses, note),
        Section("Failures", ["sequence", "frames", *(name for name, _, _ in FAILURE_COLUMNS)], failures, FAILURES),
    ]
    return [section for section in made if section.rows]


def kind_table(runs: list[dict[str, Any]], kind: tuple[str, str, str, str]) -> Section:
    """Tabulate one kind of scores."""
    quantity, map_name, views, subset = kind
    laid_out, seeds, in_sample = list[list[str]](), {run["seed"] for run in runs}, False
    for source in dict.fromkeys(run["source"] for run in runs):
        of_source = [run["scores"].get(quantity, {}).get(map_name, {}) for run in runs if run["source"] == source]
        found = [maps.get(views, {}).get(subset) for maps in of_source]
        scored = [scores for scores in found if scores]
        in_sample |= any(scores["in_sample"] for scores in scored)
        for name in scored[0]["predictors"] if scored else ():
            rows = [scores["predictors"][name] for scores in scored]
            cells = [written([value(row) for row in rows], digits) for _, digits, value in COLUMNS]
            laid_out.append([source, name, *cells])
    title = f"{quantity.replace('color', 'colour')}, {map_name}, {views}, {subset}"
    note = f"Mean ± standard deviation of {len(seeds)} seeds. " if len(seeds) > 1 else ""
    note += "The temperature T is that of the sequence itself." if in_sample else "T comes from the other sequences."
    return Section(title, ["sequence", "predictor", *(head for head, _, _ in COLUMNS)], laid_out, note)


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 2 if the options are invalid."""
    options.runs.mkdir(parents=True, exist_ok=True)
    try:
        options.run(Screen())
    except SigmaSplatError as problem:
        return program.refuse("uncertainty", problem)
    figures = kept(record.read(options.folder() / SCORES))
    print(tables.table(program.keep("uncertainty", figures, options, range(options.seeds))))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
