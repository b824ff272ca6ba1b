"""Collect the scores of a table's runs: mean and standard deviation over seeds, beside the published numbers."""

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sigmasplat.api import NETVLAD, RunFolder, lacks_netvlad, machine, make_folder, number, write_text
from sigmasplat.plugins.batch.batch import Batch
from sigmasplat.plugins.batch.definition import MEAN, Cell, Score, Table
from sigmasplat.plugins.batch.job import installed_code

OURS, PAPER = "ours", "paper"


@dataclass(frozen=True)
class Value:
    """A value of the table: the mean over `seeds` runs and their standard deviation.

    mean: None if `missing` of the runs have no such score, which no mean leaves out. scenes: of the mean over scenes,
    if it does not cover all of them: how many it covers.
    """

    mean: float | None
    deviation: float | None = None
    seeds: int = 0
    scenes: int | None = None
    missing: int = 0


@dataclass(frozen=True)
class Row:
    """One row: a score of a system, published or ours, by scene; scenes without a run are left out."""

    score: Score
    system: str
    origin: str
    values: Mapping[str, Value]


def run_record(folder: Path) -> dict[str, Any]:
    """Return the values of a run that scores can name: metrics.json, `run` (run.json) and `seconds`."""
    run = RunFolder(folder)
    return run.read_metrics() | {"run": run.facts(), "seconds": _seconds(run)}


def _seconds(run: RunFolder) -> dict[str, float]:
    """Return means of times in seconds; the first frame, which creates the map, is not counted.

    track_per_frame, track_per_iteration, map_per_keyframe, map_per_iteration (with `mapping.iterations` per keyframe).
    """
    lines = run.read_log()[1:]
    keyframes = [line for line in lines if line["is_keyframe"]]
    track, mapped = (sum(line["seconds"].get(key, 0.0) for line in lines) for key in ("track", "map"))
    steps = {
        "track_per_frame": (track, len(lines)),
        "track_per_iteration": (track, sum(line["tracking"].get("iterations") or 0 for line in lines)),
        "map_per_keyframe": (mapped, len(keyframes)),
        "map_per_iteration": (mapped, len(keyframes) * run.config().mapping.iterations),
    }
    return {name: seconds / count for name, (seconds, count) in steps.items() if count}


def rows(table: Table, cells: Sequence[Cell], records: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Return the rows: for each score the published numbers of a system, then ours; records by the name of the job."""
    systems, made = [system.name for system in table.systems], list[Row]()
    others = [published.system for published in table.published if published.system not in systems]
    for score in table.scores:
        for system in (*dict.fromkeys(others), *systems):
            numbers = [p.scores[score.name] for p in table.published if p.system == system and score.name in p.scores]
            made += [Row(score, system, PAPER, {scene: Value(n) for scene, n in of.items()}) for of in numbers]
            if system in systems:
                made.append(Row(score, system, OURS, _ours(table, score, system, cells, records)))
    return made


def _ours(
    table: Table, score: Score, system: str, cells: Sequence[Cell], records: Mapping[str, Mapping[str, Any]]
) -> dict[str, Value]:
    """Return the values of a system by scene, and the mean over the scenes of each seed that was run on all of them."""
    made = dict[str, dict[int, float | None]]()
    for cell in cells:
        if cell.system == system and cell.job.name in records:
            made.setdefault(cell.scene, {})[cell.seed] = score.value(records[cell.job.name])
    values = {scene: _value(list(of_seeds.values())) for scene, of_seeds in made.items()}
    seeds = set.intersection(*(set(of_seeds) for of_seeds in made.values())) if made else set()
    if seeds:
        means = [_value([of_seeds[seed] for of_seeds in made.values()]).mean for seed in sorted(seeds)]
        values[MEAN] = _value(means, len(made) if len(made) < len(table.scenes) else None)
    return values


def _value(values: Sequence[float | None], scenes: int | None = None) -> Value:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return Value(None, None, len(values), scenes, len(values) - len(known))
    deviation = statistics.stdev(known) if len(known) > 1 else None
    return Value(statistics.fmean(known), deviation, len(known), scenes)


@dataclass(frozen=True)
class Written:
    """A table with the scores of its finished runs. `lines` are the remarks below it: what is missing, conditions."""

    table: Table
    cells: Sequence[Cell]
    rows: Sequence[Row]
    lines: Sequence[str]
    conditions: Mapping[str, Any]

    @staticmethod
    def of(
        table: Table, cells: Sequence[Cell], batch: Batch, seeds: int, settings: Mapping[str, str], limit: int | None
    ) -> "Written":
        """Read the scores of the finished runs of a batch; settings, limit: what was changed for all runs."""
        finished = {job.name for job in batch.finished()}
        records = {name: run_record(batch.out / name) for name in finished} | {key: {} for key in batch.failed}
        conditions = {"settings": dict(settings), "limit": limit, "seeds": seeds, "code": installed_code()}
        lines = [*_remarks(table, cells, batch, conditions), *_unscored(table, records), *table.notes, *_sources(table)]
        return Written(table, cells, rows(table, cells, records), lines, conditions)

    def save(self, folder: Path) -> None:
        """Write table.md and table.json. Raises RunError if they cannot be written."""
        make_folder(folder)
        write_text(folder / "table.md", self.markdown())
        write_text(folder / "table.json", json.dumps(self.values(), indent=1, ensure_ascii=False) + "\n")

    @property
    def columns(self) -> list[str]:
        """Return the scenes, and the mean over them if there are several."""
        return [scene.name for scene in self.table.scenes] + [MEAN] * (len(self.table.scenes) > 1)

    def cells_of(self, row: Row) -> list[str]:
        """Return a row as text: score, system, a value per column."""
        shown = (self._shown(row, row.values.get(column)) for column in self.columns)
        return [row.score.title, f"{row.system} ({row.origin})", *shown]

    def _shown(self, row: Row, value: Value | None) -> str:
        if value is None:
            return number(None, 0)
        if value.mean is None:
            return "missing" if value.missing == value.seeds else f"missing ({value.missing} of {value.seeds} seeds)"
        text = number(value.mean, row.score.digits)
        text += "" if value.deviation is None else f" ± {number(value.deviation, row.score.digits)}"
        return text if value.scenes is None else f"{text} ({value.scenes} of {len(self.table.scenes)} scenes)"

    def markdown(self) -> str:
        """Return the table as Markdown."""
        head = ["score", "system", *self.columns]
        lines = [f"# {self.table.title}", "", _line(head), _line(["---", "---"] + ["---:"] * len(self.columns))]
        lines += [_line(self.cells_of(row)) for row in self.rows]
        return "\n".join([*lines, "", *(f"- {line}" for line in self.lines)]) + "\n"

    def values(self) -> dict[str, Any]:
        """Return the table as values for JSON: the conditions, the rows and the runs."""
        rows = [
            {"score": row.score.name, "unit": row.score.unit, "system": row.system, "origin": row.origin}
            | {"values": {scene: asdict(value) for scene, value in row.values.items()}}
            for row in self.rows
        ]
        runs = [{"scene": c.scene, "system": c.system, "seed": c.seed, "folder": c.job.name} for c in self.cells]
        head = {"table": self.table.name, "title": self.table.title, **self.conditions}
        return head | {"remarks": list(self.lines), "rows": rows, "runs": runs}


def _remarks(table: Table, cells: Sequence[Cell], batch: Batch, conditions: Mapping[str, Any]) -> list[str]:
    """Return the conditions of our numbers, and what is missing, as lines below the table."""
    seeds, limit, settings = (conditions[name] for name in ("seeds", "limit", "settings"))
    spread = f"{seeds} seeds, mean ± standard deviation" if seeds > 1 else "one seed"
    lines = [f"Ours: SigmaSplat {machine.package_version()} (code {conditions['code']}), {spread}."]
    changed = [f"{name}={value}" for name, value in settings.items()] + [f"the first {limit} frames"] * bool(limit)
    if changed:
        of = "of the paper" if table.published else "of the table"
        lines.append(f"Not the settings {of}: {', '.join(changed)}.")
    absent = dict.fromkeys(cell.scene for cell in cells if cell.job.name in batch.missing)
    lines += [f"Missing: {', '.join(absent)}."] if absent else []
    replaced = dict.fromkeys(cell.system for cell in cells if lacks_netvlad(cell.job.config))
    lines += [f"Replaced: NetVLAD by the built-in descriptor, in {', '.join(replaced)}; {NETVLAD}."] if replaced else []
    return lines + [f"Failed: {name}: {why}" for name, why in batch.failed.items()]


def _unscored(table: Table, records: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line if LPIPS is missing because a run had no weights."""
    wanted = any(key.endswith(".lpips") for score in table.scores for key in score.keys)
    without = any(record.get("lpips_network", "") is None for record in records.values())
    what = "LPIPS is missing for lack of weights: `sigmasplat download lpips alex`, then this command with --overwrite."
    return [what] if wanted and without else []


def _sources(table: Table) -> list[str]:
    """Return a line per source of published numbers, with the systems whose numbers are from there."""
    systems = dict[str, list[str]]()
    for published in table.published:
        systems.setdefault(published.source, []).append(published.system)
    return [f"Published: {source} ({', '.join(names)})." for source, names in systems.items()]


def _line(words: Sequence[str]) -> str:
    return "| " + " | ".join(words) + " |"
