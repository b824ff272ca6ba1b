"""Tabulate board.py: one row for each recording, and which differences to the other commit are beyond the noise."""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import record
from accuracy_tables import failed_runs
from tables import Section, significant

Run = dict[str, Any]
NOISE = "board-noise"
"""Results of several seeds (`board.py --seeds 0 1 --name board-noise`): the spread of each figure of each row."""
SEEDS_FACTOR = 2.0 * math.sqrt(2.0)
"""A difference of two runs has √2 times the deviation of one; twice that is exceeded by chance in 5 % of the cases."""


def itself(value: float) -> float:
    """Return the value: smaller is better."""
    return value


PLAIN_HEADING, BEHIND = "plain system", "worse than the plain system"


@dataclass(frozen=True)
class Quantity:
    """A figure of the board: its heading, the unit of the table, and the least difference that is not noise.

    cost: what should be small; relative, absolute: a difference of costs below relative × |cost| or below absolute is
    noise, whatever the seeds say. These floors are there because few seeds can agree by chance.
    """

    heading: str
    scale: float
    relative: float
    absolute: float
    cost: Callable[[float], float] = itself


QUANTITIES = {
    # accuracy.py, 3 seeds: the deviation of ATE is 0.3 to 3.5 % of it, of RPE up to 1.8 %
    "ate_m": Quantity("ATE, cm", 100.0, 0.05, 0.0002),
    "hops_m": Quantity("hops, mm", 1000.0, 0.03, 0.00005),
    "windows_m": Quantity("windows of 50, mm", 1000.0, 0.05, 0.0002),
    # windows of one path overlap: k is a median of few independent ones. ln 1.35 = 0.3
    "windows_k": Quantity("… k", 1.0, 0.0, 0.3, lambda k: abs(math.log(max(k, 1e-6)))),
    "lost": Quantity("lost", 1.0, 0.0, 1.0),
    "silent": Quantity("silent", 1.0, 0.0, 1.0),
    # accuracy.py: deviation of PSNR 0.02 to 0.06 dB, of depth L1 up to 0.6 %, over 40 views; here are 20
    "psnr_db": Quantity("PSNR, dB", 1.0, 0.0, 0.1, lambda db: -db),
    "depth_l1_m": Quantity("depth L1, cm", 100.0, 0.03, 0.0001),
    # the speed of a shared machine varies by as much from run to run; pace.py and startup.py measure pairs
    "cpu_s": Quantity("CPU, ms a frame", 1000.0, 0.10, 0.0),
}
"""The figures by name, in the order of the table."""


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the table of results written by board.py, beside the other commit if there is one; and failed rows."""
    figures = measured["figures"]
    now, before = ({r["name"]: r for r in mean_rows(figures["rows"], code)} for code in ("now", "before"))
    noise = record.latest(NOISE)
    spread = seeds_spread(noise["figures"]["rows"]) if noise else {}
    rows, verdicts = [], {"better": list[str](), "worse": list[str](), BEHIND: list[str]()}
    plain = {name: run.get("ate_m") for name, run in figures.get("plain", {}).items()}
    for name, run in now.items():
        cells = [name, str(run["frames"])]
        for figure, quantity in QUANTITIES.items():
            text, verdict = cell(quantity, run.get(figure), before.get(name), figure, spread.get((name, figure)))
            cells.append(text)
            if verdict:
                verdicts[verdict].append(f"{name}: {quantity.heading.split(',')[0]}")
        if plain:
            ours, theirs, deviation = run["ate_m"], plain.get(name), spread.get((name, "ate_m"))
            behind = ours and theirs and verdict_of(QUANTITIES["ate_m"], ours, theirs, deviation) == "worse"
            cells.insert(3, written(QUANTITIES["ate_m"], theirs) + " **ours is worse**" * bool(behind))
            verdicts[BEHIND] += [name] * bool(behind)
        rows.append(cells)
    head = ["recording", "frames", *(quantity.heading for quantity in QUANTITIES.values())]
    head[3:3] = [PLAIN_HEADING] * bool(plain)
    failed = failed_runs(figures["rows"], lambda r: "{name}, {code}, seed {seed}".format(**r))
    return [s for s in (Section("Board", head, rows, note(figures, verdicts, bool(before))), failed) if s.rows]


def note(figures: dict[str, Any], verdicts: dict[str, list[str]], compared: bool) -> str:
    """Return what stands below the table: verdicts, codes, what is left out, what figures mean."""
    said = []
    shown = {"better": compared, "worse": compared, BEHIND: "plain" in figures}
    said += [f"{verdict}: {'; '.join(found) or 'nothing'}." for verdict, found in verdicts.items() if shown[verdict]]
    codes = ", ".join(f"{c['name']} {c['commit'][:9]} (sources {c['digest']})" for c in figures["codes"])
    said.append(f"Code: {codes}. {figures['runs_made']} runs in {figures['duration_s']:.0f} s; the others were kept.")
    said += [f"Left out: {line}." for line in figures["left_out"]]
    unread = {f"{r['name']}, {r['code']}: {line}" for r in figures["rows"] for line in r.get("unread", ())}
    said += [f"Not read: {line}." for line in sorted(unread)]
    said.append(
        "Hops: motion from frame to frame, rms. k: the variances of windows are k times too small (median NEES / 2.37)."
        " Silent: believed and off by more than 10 cm. PSNR, depth L1: 20 held-out views. CPU: one thread."
    )
    return " ".join(said)


def mean_rows(rows: Sequence[Run], code: str) -> list[Run]:
    """Return one row for each name of a code: the means over its seeds that did not fail."""
    found = [r for r in rows if r["code"] == code and r["problem"] is None]
    means = []
    for name in dict.fromkeys(r["name"] for r in found):
        runs = [r for r in found if r["name"] == name]
        mean: Run = {"name": name, "frames": runs[0]["frames"]}
        for figure in QUANTITIES:
            values = [r[figure] for r in runs if r.get(figure) is not None]
            mean[figure] = statistics.fmean(values) if values else None
        means.append(mean)
    return means


def seeds_spread(rows: Sequence[Run]) -> dict[tuple[str, str], float]:
    """Return by name and figure the standard deviation of the cost over seeds, where there are at least two."""
    spread = {}
    good = [r for r in rows if r["code"] == "now" and r["problem"] is None]
    for name in dict.fromkeys(r["name"] for r in good):
        for figure, quantity in QUANTITIES.items():
            values = [r[figure] for r in good if r["name"] == name and r.get(figure) is not None]
            if len(values) > 1:
                spread[name, figure] = statistics.stdev(map(quantity.cost, values))
    return spread


def verdict_of(quantity: Quantity, now: float, before: float, deviation: float | None) -> str:
    """Return "better", "worse", or "" for a difference that may be noise; deviation: of the cost over seeds."""
    costs = quantity.cost(now), quantity.cost(before)
    difference = costs[0] - costs[1]
    noise = max(quantity.absolute, quantity.relative * abs(costs[1]), SEEDS_FACTOR * (deviation or 0.0))
    if abs(difference) <= noise:
        return ""
    return "worse" if difference > 0 else "better"


def cell(
    quantity: Quantity, now: float | None, before: Run | None, figure: str, deviation: float | None
) -> tuple[str, str]:
    """Return a cell, `before → now` if there is another commit, and its verdict. A figure that is missing on one side
    only has none."""
    text = written(quantity, now)
    if before is None:
        return text, ""
    earlier = before.get(figure)
    verdict = "" if now is None or earlier is None else verdict_of(quantity, now, earlier, deviation)
    both = text if now == earlier else f"{written(quantity, earlier)} → {text}"
    return f"{both} **{verdict}**" if verdict else both, verdict


def written(quantity: Quantity, value: float | None) -> str:
    """Write a figure in the unit of the table; counts without decimals."""
    if value is not None and float(quantity.scale * value).is_integer() and quantity.absolute == 1.0:
        return str(int(value))
    return significant(None if value is None else quantity.scale * value)
