"""Tabulate the results of what_variance_is_good_for.py."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student
from tables import Section, significant
from what_variance_maps import MIRRORS
from what_variance_poses import CONDITIONS, NONE, ONE_SIGMA, ORACLE_LIKELIHOOD, REAL_LIKELIHOOD, WEIGHTS

Windows = Sequence[Mapping[str, Any]]
Cluster = Callable[[Mapping[str, Any]], object]
SCORES = {
    "share": "σ² in V, %",
    "ratio": "V / r²",
    "spearman": "Spearman",
    "spearman_scatter": "… of Var(E)",
    "nll": "NLL",
    "nll_scaled": "NLL, best factor",
}


def errors(windows: Windows, condition: str, weights: str) -> list[float]:
    """Return the position errors, mm, of all live frames."""
    return [mm for window in windows for mm in window["poses"][condition][weights]["mm"]]


def clusters(windows: Windows, by: Cluster) -> list[Windows]:
    """Group windows: figures of one recording, or of one room, are not independent."""
    keys = dict.fromkeys(map(by, windows))
    return [[window for window in windows if by(window) == key] for key in keys]


def change(windows: Windows, condition: str, weights: str, against: str) -> float:
    """Return the change of the mean position error by weights, %."""
    before, after = (float(np.mean(errors(windows, condition, name))) for name in (against, weights))
    return 100.0 * (after / before - 1.0)


def interval(values: Sequence[float]) -> str:
    """Write the mean of clusters and half of its 95 % interval (Student's t), as one word."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return f"{mean:+.0f}"
    half = float(student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values)))
    return f"{mean:+.0f}±{half:.0f}"


def changes(title: str, windows: Windows, by: Cluster, note: str) -> Section:
    """Tabulate the change of the position error by weights in every condition."""
    groups = clusters(windows, by)
    plain = [significant(float(np.mean([np.mean(errors(g, c, NONE)) for g in groups]))) for c in CONDITIONS]
    rows = [[f"{NONE}: error, mm", *plain]]
    for name in WEIGHTS:
        if name != NONE:
            rows.append([name, *(interval([change(g, c, name, NONE) for g in groups]) for c in CONDITIONS)])
    for name in (REAL_LIKELIHOOD, ORACLE_LIKELIHOOD):
        cells = [interval([change(g, c, name, ONE_SIGMA) for g in groups]) for c in CONDITIONS]
        rows.append([f"{name}, against {ONE_SIGMA}", *cells])
    note += f" {len(windows)} windows, {len(errors(windows, next(iter(CONDITIONS)), NONE))} frames."
    return Section(title, ["weights", *CONDITIONS], rows, note)


def paired(windows: Windows) -> Section:
    """Tabulate the mean paired difference of each source, mm, ± standard error over frames."""
    rows = []
    for group in clusters(windows, lambda window: window["source"]):
        for condition in CONDITIONS:
            before = np.array(errors(group, condition, NONE))
            cells = [f"{before.mean():.2f}"]
            for name in WEIGHTS:
                if name != NONE:
                    off = np.array(errors(group, condition, name)) - before
                    cells.append(f"{off.mean():+.2f} ± {off.std(ddof=len(off) > 1) / math.sqrt(len(off)):.2f}")
            rows.append([group[0]["source"], condition, str(len(before)), *cells])
    head = ["source", "condition", "frames", f"{NONE}, mm", *(name for name in WEIGHTS if name != NONE)]
    return Section("Paired differences, mm", head, rows, "Mean ± standard error over frames, weights − none.")


def learned(windows: Windows) -> Section:
    """Tabulate the scores of every way to learn σ²: means over sources; "as trained": of their last windows."""
    rows = []
    for name in dict.fromkeys(name for window in windows for name in window["sigma"]):
        having = [window for window in windows if name in window["sigma"]]
        groups = clusters(having, lambda window: window["source"])
        cells = []
        for score in SCORES:
            means = [float(np.mean([window["sigma"][name][score] for window in group])) for group in groups]
            factor = 100.0 if score == "share" else 1.0
            deviation = f"±{factor * np.std(means, ddof=1):.2g}" if len(means) > 1 else ""
            cells.append(f"{factor * np.mean(means):.2f}{deviation}")
        rows.append([name, *cells])
    note = "Held-out frames at true poses; mean ± standard deviation over sources. r²: squared error of colour."
    return Section("Ways to learn σ²", ["σ²", *SCORES.values()], rows, note)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by what_variance_is_good_for.py."""
    windows = measured["figures"]["windows"]
    plain = [window for window in windows if window["source"] != MIRRORS]
    mirrors = [window for window in windows if window["source"] == MIRRORS]
    note = "Change of the position error, %: mean ± half of its 95 % interval, clustered by {}; negative is better."
    made = []
    if plain:
        made.append(changes("Recordings and room", plain, lambda w: w["source"], note.format("source")))
    if mirrors:
        made.append(changes("Room with mirrors", mirrors, lambda w: w["seed"], note.format("room")))
    return [*made, learned(windows), paired(windows)]
