"""Tabulate runs on disturbed recordings: the whole suite, and each disturbance."""

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from accuracy_tables import failed_runs, spread
from disturbances import DISTURBANCES
from tables import Section, significant

Run = dict[str, Any]
BOUNDS_CM = (2, 5, 10, 20)
SILENT_GOAL, AUROC_GOAL = 0.01, 0.9
DECLARED_GOAL, FOUND_GOAL, ATE_RATIO_GOAL = 3, 10, 1.5
HEAD = ("disturbance", "severity")


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by robustness.py."""
    figures = measured["figures"]
    made = [
        _suite(figures),
        *(_sequence(name, _of(figures["runs"], sequence=name)) for name in _names(figures)),
        _calibration(figures["p_off"]),
        goals(figures),
        failed_runs(figures["runs"], lambda r: "{sequence}, {disturbance} {severity}, seed {seed}".format(**r)),
    ]
    return [section for section in made if section.rows]


NOTE = (
    "ATE of the valid frames; a run that believes less than half of the frames outside the event does not count as "
    "below a bound. Lost: not valid. Silent: valid and off by more than 10 cm."
)


def _of(runs: Sequence[Run], **wanted: Any) -> list[Run]:
    """Return the successful runs with these values."""
    return [run for run in runs if run["problem"] is None and all(run[name] == v for name, v in wanted.items())]


def _names(figures: dict[str, Any]) -> list[str]:
    """Return the sequences, in order."""
    return list(dict.fromkeys(run["sequence"] for run in figures["runs"]))


def _rows(runs: Sequence[Run]) -> list[tuple[str, str, list[Run]]]:
    """Return title and severity of each disturbance that was run, and its runs."""
    found = []
    for name, disturbance in DISTURBANCES.items():
        for severity, label in enumerate(disturbance.labels, 1):
            if at := _of(runs, disturbance=name, severity=severity):
                found.append((disturbance.title, label, at))
    return found


# ---- figures ----


def succeeded(run: Run, bound_cm: float) -> bool:
    """Return whether the ATE is below a bound, and at least half of the frames outside the event are valid."""
    enough = run["missed_outside"] <= run["outside"] / 2
    return bool(enough and run["ate_m"] is not None and 100 * run["ate_m"] < bound_cm)


def _percent(share: float) -> str:
    """Write a share in percent."""
    return significant(100 * share, 2 if share < 0.1 else 3) if share else "0"


def share_of_frames(runs: Sequence[Run], figure: str) -> float:
    """Return a number of frames, added over the runs, as a share of all frames; 0 without runs."""
    return float(sum(run[figure] for run in runs) / max(sum(run["frames"] for run in runs), 1))


def _success(runs: Sequence[Run], bound_cm: float = 5) -> str:
    return _percent(statistics.fmean(succeeded(run, bound_cm) for run in runs)) if runs else "–"


def _lost(runs: Sequence[Run]) -> str:
    """Return the share of the frames that are not valid."""
    return _percent(1 - share_of_frames(runs, "believed")) if runs else "–"


def _silent(runs: Sequence[Run]) -> str:
    return _percent(share_of_frames(runs, "silent")) if runs else "–"


def _ates_cm(runs: Sequence[Run]) -> list[float]:
    return [100 * run["ate_m"] for run in runs if run["ate_m"] is not None]


def _auroc(p_off: dict[str, Any] | None) -> str:
    return significant(p_off["auroc"]) if p_off else "–"


def _suite(figures: dict[str, Any]) -> Section:
    """Tabulate the whole suite: a column for each sequence, and one for all."""
    names = _names(figures)
    columns = [_of(figures["runs"]), *(_of(figures["runs"], sequence=name) for name in names)]

    def row(title: str, write: Callable[[list[Run]], str]) -> list[str]:
        return [title, *(write(runs) for runs in columns)]

    rows = [row("runs", lambda runs: str(len(runs)))]
    rows += [
        row(f"runs with ATE < {bound} cm, %", lambda runs, bound=bound: _success(runs, bound))  # type: ignore[misc]
        for bound in BOUNDS_CM
    ]
    rows += [row("frames lost, %", _lost), row("silent failures, % of frames", _silent)]
    if figures["p_off"]:
        rows += [
            [title, significant(figures["p_off"][name]), *("–" for _ in names)]
            for title, name in (("AUROC of p_off", "auroc"), ("Brier score of p_off", "brier"))
        ]
    left_out = "".join(f" Left out: {line}." for line in figures.get("left_out", ()))
    note = f"Code that was measured: commit {str(figures['measured'])[:9]}. {NOTE}{left_out}"
    return Section("Suite", ["figure", "all", *names], rows, note)


def _sequence(name: str, all_runs: list[Run]) -> Section:
    """Tabulate the disturbances of a sequence: means ± standard deviation over the seeds."""
    rows = []
    for title, label, runs in _rows(all_runs):
        counts = (
            [run["frames"] for run in runs],
            [run["frames"] - run["believed"] for run in runs],
            [run["silent"] for run in runs],
            [run["silent_in_a_row"] for run in runs],
        )
        cells = [spread([float(number) for number in numbers]) for numbers in counts]
        back = _back([run for run in runs if run["event"]], "recovery")
        known = _back([run for run in runs if run["known"] is not None], "recovery_known")
        rows.append([title, label, spread(_ates_cm(runs)), *cells, back, known])
    head = [*HEAD, "ATE, cm", "frames", "lost", "silent", "… in a row", "back after", "back in a known view after"]
    note = (
        "Mean ± standard deviation over the seeds. In a row: the longest time, in frames, until a silent failure is "
        "declared. Back: frames from the end of the event, or from the first known view after it, to the first right "
        "pose; in brackets: in how many runs that happens, if not in all."
    )
    return Section(name, head, rows, note)


def _back(runs: Sequence[Run], figure: str) -> str:
    """Write a number of frames until a right pose, and in how many of the runs there is one; a dash without runs."""
    found = [float(run[figure]) for run in runs if run[figure] is not None]
    some = f" ({len(found)} of {len(runs)})" if 0 < len(found) < len(runs) else ""
    return (spread(found) + some if found else "never") if runs else "–"


def _calibration(p_off: dict[str, Any] | None) -> Section:
    """Tabulate how often a pose is off, by the probability that was given for it."""
    rows = [
        [str(part["frames"]), significant(part["mean_p"]), significant(part["off"])]
        for part in (p_off["calibration"] if p_off else [])
    ]
    note = "Every frame with a pose in log.jsonl, in ten bins of p_off. Off: by more than 5 cm."
    return Section("Calibration of p_off", ["frames", "mean p_off", "share that is off"], rows, note)


def goals(figures: dict[str, Any]) -> Section:
    """Compare the suite with the goals of issue 16; empty for a checkout without p_off."""
    runs, p_off = _of(figures["runs"]), figures["p_off"]
    if not p_off or not runs:
        return Section("Goals", [], [])
    silent, kidnapped = share_of_frames(runs, "silent"), _of(runs, disturbance="kidnapped")
    rows = [_goal("silent failures ≤ 1 % of frames", f"{_percent(silent)} %", silent <= SILENT_GOAL)]
    if p_off["auroc"] is not None:
        rows.append(_goal("AUROC of p_off ≥ 0.9", significant(p_off["auroc"]), p_off["auroc"] >= AUROC_GOAL))
    for figure, limit, text in (
        ("silent_in_a_row", DECLARED_GOAL, "kidnapped: a wrong pose is declared lost within 3 frames"),
        ("recovery_known", FOUND_GOAL, "kidnapped: found within 10 frames of a known view"),
    ):
        held = [run[figure] is not None and run[figure] <= limit for run in kidnapped]
        rows += [_goal(text, f"{sum(held)} of {len(held)} runs", all(held))] if held else []
    ratios = [
        run["ate_m"] / clean["ate_m"]
        for run in kidnapped
        for clean in _of(runs, disturbance="clean", sequence=run["sequence"], seed=run["seed"])
        if run["ate_m"] is not None and clean["ate_m"]
    ]
    if ratios:
        text = "kidnapped: ATE of valid frames ≤ 1.5 × that of the undisturbed run"
        rows.append(_goal(text, f"{significant(max(ratios))} at most", max(ratios) <= ATE_RATIO_GOAL))
    return Section("Goals", ["goal", "measured", "reached by all"], rows)


def _goal(text: str, measured: str, held: bool) -> list[str]:
    return [text, measured, "yes" if held else "**no**"]
