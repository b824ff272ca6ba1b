"""Score predicted variances at views that the map was not fitted to, and those of poses: sigmasplat bench
uncertainty."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmasplat.commands import options
from sigmasplat.commands.input_options import Limit
from sigmasplat.commands.options import prepare_torch
from sigmasplat.config.presets import default_preset
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from sigmasplat.plugins.evaluation.uncertainty_benchmark import Job, Measured, Study
    from sigmasplat.run.terminal import Screen

DEFAULT_PRESET = default_preset()
WIDTH = 132
"""Width of a table in characters if the output is not a terminal."""
MANY = 100.0
"""A larger figure is shown without decimals."""
TRANSFERRED = "after: after the temperature T from the other sequences; constant, 1 − A: best scale on these pixels"
IN_SAMPLE = "after: after the temperature T of this sequence itself (in-sample); give several sequences to transfer it"


@dataclass(frozen=True)
class Uncertainty:
    """Score how well predicted variances match the errors of rendered views, and compare with simple baselines. Also
    score the covariance of poses and the probability of a wrong pose.

    Frames are held back from the map (input.hold_every) and rendered afterwards. Temperatures come from the other
    sequences, so give several. Finished runs in DIR are reused.

    example: sigmasplat bench uncertainty data/kitchen synthetic:frames=120,noise=1,test_views=24 --limit 120
    """

    sources: options.SourcePaths
    preset: options.PresetName = DEFAULT_PRESET
    settings: options.Settings = ()
    seeds: options.Runs = 1
    limit: Limit = None
    hold_every: options.HoldEvery = 8
    views: options.MostViews = 24
    out: options.StudyFolder = Path("uncertainty")
    overwrite: options.Overwrite = False

    def study(self) -> "Study":
        """Return what to measure. Raises ConfigError on invalid values."""
        from sigmasplat.plugins.evaluation.uncertainty_benchmark import Study, study_config

        if not self.sources:
            raise ConfigError("no SOURCE given; give one or more folders of sequences")
        config = study_config(self.preset, self.settings)
        sources = tuple(dict.fromkeys(self.sources))
        given = tuple(split_settings(self.settings))
        return Study(sources, config, self.seeds, self.limit, self.hold_every, self.views, given)

    def run(self) -> int:
        """Make the missing runs, score all of them, print the tables, and return 0. Raises SigmaSplatError."""
        from sigmasplat.plugins.evaluation.uncertainty_benchmark import HELD_BACK
        from sigmasplat.plugins.evaluation.uncertainty_files import SCORES, StudyFolder
        from sigmasplat.plugins.sources import open_source
        from sigmasplat.run.terminal import Screen

        screen, study = Screen(), self.study()
        jobs = study.jobs()
        folder = StudyFolder.create(self.out, study, self.overwrite)
        for job in jobs:
            open_source(job.path, job.config.input)  # a wrong path fails now and not after hours
        prepare_torch()
        measured = []
        for number, job in enumerate(jobs, 1):
            found = folder.load(job)
            if found is None:
                screen.say(f"[{number}/{len(jobs)}] {job.source}, seed {job.seed}")
                found = run_job(job, study.views, screen)
                folder.save(job, found)
            if not found.facts["views"][HELD_BACK]:
                screen.warn(f"{job.source}, seed {job.seed}: no frame that was held back has a valid pose")
            measured.append(found)
        runs = folder.write(jobs, measured)
        if not screen.out.is_terminal:
            screen.out.width = WIDTH
        for source in study.sources:
            of_source = [run for run in runs if run["source"] == source]
            for made in (*tables(source, of_source), *path_tables(source, of_source)):
                screen.out.print(made)
        screen.say(f"{len(runs)} runs: {self.out / SCORES}")
        return 0


def run_job(job: "Job", views: int, screen: "Screen") -> "Measured":
    """Run SLAM with a job's settings and collect its samples."""
    from sigmasplat.plugins.evaluation.finished_run import run_slam
    from sigmasplat.plugins.evaluation.uncertainty_benchmark import measure
    from sigmasplat.run.scene import open_scene

    source, config = open_scene(job.path, job.config, job.given)
    with screen.steps(len(source)) as show:
        run = run_slam(config, source, show)
    with screen.counting("views") as progress:
        return measure(run, source, views, progress=progress)


def tables(source: str, runs: Sequence[dict[str, Any]]) -> Iterator["Table"]:
    """Yield a table per quantity, map, kind of views and subset of pixels, with the mean over a sequence's runs."""
    for quantity, maps in runs[0]["scores"].items():
        for map_name, kinds in maps.items():
            for views, subsets in kinds.items():
                for subset in subsets:
                    found = [run["scores"][quantity].get(map_name, {}).get(views, {}).get(subset) for run in runs]
                    title = f"{source}: {quantity.replace('color', 'colour')}, {map_name}, {views}, {subset}"
                    yield _table(title, [scores for scores in found if scores])


def path_tables(source: str, runs: Sequence[dict[str, Any]]) -> Iterator["Table"]:
    """Yield a table of the scores of pose covariances and one of those of `p_off`, where they are known."""
    from rich.table import Table

    for title, head, columns, rows in (
        ("poses", "motion", POSE_COLUMNS, pose_rows(runs)),
        ("failures", "frames", FAILURE_COLUMNS, failure_rows(runs)),
    ):
        made = Table(head, title=f"{source}: {title}")
        for name, _, _ in columns:
            made.add_column(name, justify="right")
        for cells in rows:
            made.add_row(*cells)
        if rows:
            yield made


def pose_rows(runs: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return a row for each kind of motion that was scored: its name, and the cells of `POSE_COLUMNS`."""
    from sigmasplat.plugins.evaluation.pose_covariance import MOTIONS

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


def _table(title: str, of_runs: Sequence[dict[str, Any]]) -> "Table":
    """Return the mean scores of each predictor; with several runs, their standard deviation too."""
    from rich.table import Table

    made = Table("predictor", title=title, caption=IN_SAMPLE if of_runs[0]["in_sample"] else TRANSFERRED)
    for head, _, _ in COLUMNS:
        made.add_column(head, justify="right")
    for name in of_runs[0]["predictors"]:
        rows = [run["predictors"][name] for run in of_runs]
        made.add_row(name, *(written([value(row) for row in rows], digits) for _, digits, value in COLUMNS))
    return made


def written(values: Sequence[float | None], digits: int) -> str:
    """Write the mean of the known values, ± their standard deviation if there are several."""
    import statistics

    from sigmasplat.run.figures import number

    known = [value for value in values if value is not None and value == value]
    if not known:
        return number(None, 0)
    mean = statistics.fmean(known)
    shown = number(mean, digits if abs(mean) < MANY else 0)
    return (
        shown if len(known) < 2 else f"{shown} ± {number(statistics.stdev(known), digits if abs(mean) < MANY else 0)}"
    )
