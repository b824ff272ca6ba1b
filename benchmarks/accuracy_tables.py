"""Tabulate the figures of the accuracy benchmark: mean ± standard deviation over seeds, and the goals."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tables import Section, significant

Result = dict[str, Any]
PLACE = (
    ("ATE, cm", "ate_m", 100.0),
    ("RPE, cm", "rpe_m", 100.0),
    ("RPE, °", "rpe_deg", 1.0),
    ("lost", "lost", 1.0),
    ("frames", "frames", 1.0),
    ("frames/s", "frames_per_s", 1.0),
    ("splats, k", "splats", 1e-3),
    ("peak memory, MiB", "peak_mib", 1.0),
)
PICTURES = (
    ("PSNR held-out, dB", "held_out_psnr_db", 1.0),
    ("… training", "training_psnr_db", 1.0),
    ("SSIM held-out", "held_out_ssim", 1.0),
    ("… training", "training_ssim", 1.0),
    ("depth L1 held-out, cm", "held_out_depth_l1_m", 100.0),
    ("… training", "training_depth_l1_m", 100.0),
    ("Spearman V ~ error²", "spearman", 1.0),
    ("AUSE", "ause", 1.0),
    ("NLL", "nll", 1.0),
)
"""Title, name of the figure, factor to the unit of the title."""


@dataclass(frozen=True)
class Goal:
    """A limit for every seed of a whole sequence with the default preset (issues 2 and 3)."""

    source: str
    figure: str
    text: str
    held: Callable[[float], bool]


GOALS = (
    Goal("synthetic", "ate_m", "ATE ≤ 1 cm", lambda x: x <= 0.01),
    Goal("synthetic", "held_out_psnr_db", "held-out PSNR ≥ 27 dB", lambda x: x >= 27.0),
    Goal("synthetic", "spearman", "Spearman > 0", lambda x: x > 0.0),
    Goal("redkitchen", "lost", "never lost", lambda x: x == 0),
    Goal("redkitchen", "ate_m", "ATE ≤ 4 cm", lambda x: x <= 0.04),
    Goal("redkitchen", "frames_per_s", "≥ 12 frames/s", lambda x: x >= 12.0),
    Goal("redkitchen", "held_out_psnr_db", "held-out PSNR ≥ 23.4 dB", lambda x: x >= 23.4),
    Goal("redkitchen", "peak_mib", "memory < 4 GB", lambda x: x < 4e9 / 2**20),
    Goal("redkitchen", "spearman", "Spearman > 0", lambda x: x > 0.0),
    Goal("livingroom", "ate_m", "ATE ≤ 1 cm", lambda x: x <= 0.01),
    Goal("livingroom", "held_out_psnr_db", "held-out PSNR ≥ 27 dB", lambda x: x >= 27.0),
    Goal("livingroom", "spearman", "Spearman > 0", lambda x: x > 0.0),
)
GOAL_PRESET = "sigma"
FACTORS = {figure: factor for _, figure, factor in (*PLACE, *PICTURES)}


def mean_std(values: list[float]) -> tuple[float, float | None]:
    """Return mean and sample standard deviation; the deviation of a single value is None."""
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None


def spread(values: list[float]) -> str:
    """Write mean ± standard deviation; one number if all values are the same integer; a dash without values."""
    if not values:
        return "–"
    mean, std = mean_std(values)
    if mean.is_integer() and not std:
        return f"{mean:.0f}"
    return significant(mean) + ("" if std is None else f" ± {significant(std, 2)}")


def values_of(results: list[Result], figure: str) -> list[float]:
    """Return a figure of every run that has it."""
    all_values = [result.get(figure, result["figures"].get(figure)) for result in results]
    return [float(value) for value in all_values if value is not None]


def groups(results: list[Result]) -> dict[tuple[str, str], list[Result]]:
    """Group the successful runs by source and preset, in order."""
    grouped: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        members = grouped.setdefault((result["job"]["source"], result["job"]["preset"]), [])
        if result["problem"] is None:
            members.append(result)
    return grouped


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by accuracy.py."""
    results = measured["figures"]["jobs"]
    made = [_figures("Path and speed", PLACE, results), _figures("Map and uncertainty", PICTURES, results)]
    return [s for s in [*made, goals(measured), failures(results)] if s.rows]


def _figures(title: str, figures: tuple[tuple[str, str, float], ...], results: list[Result]) -> Section:
    rows = [
        [source, preset, str(len(runs)), *(spread([f * v for v in values_of(runs, name)]) for _, name, f in figures)]
        for (source, preset), runs in groups(results).items()
    ]
    note = "Mean ± standard deviation over the seeds. Views are rendered at estimated poses."
    return Section(title, ["sequence", "preset", "runs", *(name for name, _, _ in figures)], rows, note)


def goals(measured: dict[str, Any]) -> Section:
    """Compare every seed with each goal; only for whole sequences with the unchanged default preset."""
    rows = []
    config = measured["config"]
    whole = config.get("limit") is None and not config.get("settings")
    for goal in GOALS if whole else ():
        runs = groups(measured["figures"]["jobs"]).get((goal.source, GOAL_PRESET), [])
        values = values_of(runs, goal.figure)
        if values:
            shown = ", ".join(significant(FACTORS[goal.figure] * value) for value in values)
            rows.append([f"{goal.source}: {goal.text}", shown, "yes" if all(map(goal.held, values)) else "**no**"])
    return Section("Goals", ["goal", "measured, each seed", "reached by all"], rows)


def failures(results: list[Result]) -> Section:
    """List the runs that failed, with the last line they printed."""
    return failed_runs(
        results, lambda r: ", ".join((r["job"]["source"], r["job"]["preset"], f"seed {r['job']['seed']}"))
    )


def failed_runs(results: list[Result], name: Callable[[Result], str]) -> Section:
    """List the results that have a `problem`, each with its name and the last line it printed."""
    failed = [result for result in results if result["problem"] is not None]
    rows = [[name(result), str(result["problem"]).replace("|", "/")] for result in failed]
    return Section("Failed", ["run", "last line"], rows)
