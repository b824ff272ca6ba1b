"""Collect the scores of a table's runs: mean and standard deviation over seeds, beside the published numbers."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sigmasplat.plugins.batch.definition import MEAN, Cell, Score, Table
from sigmasplat.run_folder.runs import RunFolder

OURS, PAPER = "ours", "paper"


@dataclass(frozen=True)
class Value:
    """A value of the table: the mean over `seeds` runs and their standard deviation.

    scenes: of the mean over scenes, if it does not cover all of them: how many it covers.
    """

    mean: float
    deviation: float | None = None
    seeds: int = 0
    scenes: int | None = None


@dataclass(frozen=True)
class Row:
    """One row: a score of a system, published or ours, by scene; a missing value is left out."""

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
    systems = [system.name for system in table.systems]
    others = [published for published in table.published if published.system not in systems]
    made = list[Row]()
    for score in table.scores:
        made += [_published(score, published.system, published.scores[score.name]) for published in others
                 if score.name in published.scores]  # fmt: skip
        for system in systems:
            of_paper = [p.scores[score.name] for p in table.published if p.system == system and score.name in p.scores]
            made += [_published(score, system, numbers) for numbers in of_paper]
            made.append(Row(score, system, OURS, _ours(table, score, system, cells, records)))
    return made


def _published(score: Score, system: str, numbers: Mapping[str, float]) -> Row:
    return Row(score, system, PAPER, {scene: Value(number) for scene, number in numbers.items()})


def _ours(
    table: Table, score: Score, system: str, cells: Sequence[Cell], records: Mapping[str, Mapping[str, Any]]
) -> dict[str, Value]:
    """Return the values of a system by scene, and the mean over scenes of each seed that has all known scenes."""
    known = dict[str, dict[int, float]]()
    for cell in cells:
        value = score.value(records.get(cell.job.name, {})) if cell.system == system else None
        if value is not None:
            known.setdefault(cell.scene, {})[cell.seed] = value
    values = {scene: _value(list(of_seeds.values())) for scene, of_seeds in known.items()}
    seeds = set.intersection(*(set(of_seeds) for of_seeds in known.values())) if known else set()
    if seeds:
        means = [statistics.fmean(of_seeds[seed] for of_seeds in known.values()) for seed in sorted(seeds)]
        values[MEAN] = _value(means, len(known) if len(known) < len(table.scenes) else None)
    return values


def _value(values: Sequence[float], scenes: int | None = None) -> Value:
    deviation = statistics.stdev(values) if len(values) > 1 else None
    return Value(statistics.fmean(values), deviation, len(values), scenes)
