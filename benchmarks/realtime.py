"""Measure real time: recordings replayed at a camera's rate, beside runs in which a frame waits for the one before it.

A recording with another rate than `--rate` is replayed at this rate, in both runs. For each sequence and seed one run
with --realtime and one without, each in a process of its own, one after the other. Figures come from the logs and
scores of the runs: time from the arrival of an image to its pose, dropped frames, ATE and PSNR relative to the run
without --realtime.
Writes benchmarks/results/realtime-<machine>.json and prints tables.

example: python benchmarks/realtime.py --sources livingroom --seeds 0
"""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from replayed import at_rate
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset
from sigmasplat.errors import SigmaSplatError
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
FIRST_S = 1.0
"""Latencies of the first second are left out: libraries are loaded then, and the first map is made."""
GOALS = {"p50_ms": 12.0, "p99_ms": 33.0, "worst_ms": 66.0, "dropped": 0.0, "ate_ratio": 1.2, "psnr_loss_db": 1.0}
"""Largest values that meet the goals."""


@dataclass(frozen=True)
class Options:
    """Replay recordings at a camera's rate; measure latency, dropped frames, ATE and PSNR."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen",
        "livingroom",
    )
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, two runs for each")] = (0, 1, 2)
    rate: Annotated[float, arg(help="frames per second")] = 30.0
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    limit: Annotated[int | None, arg(help="number of frames at most")] = None
    name: Annotated[str, arg(help="name of the results")] = "realtime"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(source: str, seed: int, options: Options) -> dict[str, Any]:
    """Run one sequence with and without --realtime; return the figures of both. Raises SigmaSplatError if a run
    fails."""
    with tempfile.TemporaryDirectory() as scratch, at_rate(Path(source), options.rate) as replayed:
        found = {
            name: figures_of(made(str(replayed), seed, options, Path(scratch) / name, *more))
            for name, more in (("realtime", ("--realtime",)), ("in_turn", ()))
        }
    return {"source": Path(source).name, "seed": seed} | compared(found["realtime"], found["in_turn"])


def made(source: str, seed: int, options: Options, out: Path, *more: str) -> RunFolder:
    """Make one run in a process of its own. Raises SigmaSplatError with its error line if it fails."""
    command = [sys.executable, "-m", "sigmasplat.cli", "run", source, "--preset", options.preset, "--out", str(out)]
    command += ["--seed", str(seed), *more, *(word for setting in options.settings for word in ("--set", setting))]
    command += [] if options.limit is None else ["--limit", str(options.limit)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SigmaSplatError(f"{source}: {done.stderr.strip().splitlines()[-1:]}")
    return RunFolder.open(out)


def figures_of(run: RunFolder) -> dict[str, Any]:
    """Return the figures of one run."""
    log, metrics = run.read_log(), run.read_metrics()
    late = settled([line["timestamp_s"] for line in log])
    latencies_ms = [1000 * line["seconds"]["latency"] for line in compress(log, late) if "latency" in line["seconds"]]
    return {
        "frames": len(log),
        "lost": sum(line["lost"] for line in log),
        "keyframes": sum(line["is_keyframe"] for line in log),
        "dropped": run.facts().get("dropped"),
        "ate_cm": 100 * metrics["ate"]["rmse_m"] if metrics["ate"] else None,
        "psnr_db": metrics["training"]["psnr_db"],
        "latency_ms": latency(latencies_ms) if latencies_ms else None,
    }


def settled(times_s: Sequence[float]) -> list[bool]:
    """Return which frames, by their times, count: those after the first second."""
    return [time_s - times_s[0] > FIRST_S for time_s in times_s]


def latency(values_ms: list[float]) -> dict[str, float]:
    """Return median, 99 % and maximum of latencies."""
    p50, p99 = np.quantile(values_ms, [0.5, 0.99])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "worst": round(max(values_ms), 2)}


def compared(realtime: dict[str, Any], in_turn: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a run in real time and of the other run, and the comparison of both."""
    ratio = realtime["ate_cm"] / in_turn["ate_cm"] if realtime["ate_cm"] and in_turn["ate_cm"] else None
    return {
        "realtime": realtime,
        "in_turn": in_turn,
        "ate_ratio": ratio,
        "psnr_loss_db": in_turn["psnr_db"] - realtime["psnr_db"],
    }


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table: a row for each run, and one with the goals."""
    head = ["sequence", "seed", "image to pose, ms: median", "99 %", "worst", "dropped frames", "lost frames"]
    head += ["ATE, cm", "relative to the run in turn", "PSNR lost, dB"]
    rows = [row(found) for found in measured["figures"]["runs"]]
    g = GOALS
    goals = [g["p50_ms"], g["p99_ms"], g["worst_ms"], g["dropped"], None, None, g["ate_ratio"], g["psnr_loss_db"]]
    rows.append(["goal", "", *("" if goal is None else f"≤ {goal:g}" for goal in goals)])
    rate = measured["config"].get("rate", 30.0)  # results before this option were at 30
    note = (
        f"Each sequence is replayed at {rate:g} frames per second (`run --realtime`). *In turn*: the same run without "
        "`--realtime`, where each frame waits for the one before it. Latencies leave the first second out. PSNR on "
        "training views of the final map."
    )
    return [Section("Real time", head, rows, note)]


def row(found: dict[str, Any]) -> list[str]:
    """Return the row of one run."""
    r = found["realtime"]
    times = [significant(r["latency_ms"][name]) for name in ("p50", "p99", "worst")] if r["latency_ms"] else ["–"] * 3
    ate = "–" if r["ate_cm"] is None else significant(r["ate_cm"])
    ratio = "–" if found["ate_ratio"] is None else f"{found['ate_ratio']:.2f}"
    counts = [str(r["dropped"]), str(r["lost"])]
    return [found["source"], str(found["seed"]), *times, *counts, ate, ratio, f"{found['psnr_loss_db']:.2f}"]


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every sequence and seed."""
    return {"runs": [measure(accuracy.located(s), seed, options) for s in options.sources for seed in options.seeds]}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("realtime", options, measure_all, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
