"""Score predicted variances at views held back from the map, on six sequences, with `sigmasplat bench uncertainty`.

Finished runs are kept in runs/bench/uncertainty/NAME and are not repeated while code and settings are unchanged.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes its tables into the documents.

example: python benchmarks/uncertainty.py --sources redkitchen livingroom --seeds 1 --limit 120 --set input.width=240
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import tyro
from ablation import short
from tables import Section

from sigmasplat.commands import options as described
from sigmasplat.commands.bench_uncertainty import (
    COLUMNS,
    DEFAULT_PRESET,
    FAILURE_COLUMNS,
    POSE_COLUMNS,
    Uncertainty,
    failure_rows,
    pose_rows,
    written,
)
from sigmasplat.commands.input_options import Limit
from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
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


@dataclass(frozen=True)
class Options:
    """Score predicted variances at views held back from the map."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = SOURCES
    preset: described.PresetName = DEFAULT_PRESET
    settings: described.Settings = ()
    seeds: described.Runs = 3
    limit: Limit = None
    hold_every: described.HoldEvery = 8
    views: described.MostViews = 24
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "uncertainty"
    runs: Annotated[Path, arg(help="folder of finished runs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def folder(self) -> Path:
        """Return the folder of the samples."""
        return self.runs / record.slug(self.name)

    def command(self) -> Uncertainty:
        """Return the command to run."""
        return Uncertainty(
            tuple(map(located, self.sources)), self.preset, self.settings, self.seeds, self.limit, self.hold_every,
            self.views, self.folder(), overwrite=True,
        )  # fmt: skip


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
        options.command().run()
    except SigmaSplatError as problem:
        return program.refuse("uncertainty", problem)
    figures = kept(record.read(options.folder() / "uncertainty.json"))
    print(tables.table(program.keep("uncertainty", figures, options, range(options.seeds))))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
