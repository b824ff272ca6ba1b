"""Measure what the search for moving things costs where nothing moves: time of frames with and without it, by turns.

Two systems, one with the search and one without it, get the same frames in one process. Each frame is processed by one
and then by the other, in alternating order: the speed of a machine changes from second to second, and this changes
both alike. The final map is not made.
Writes benchmarks/results/search-cost-<machine>.json and prints its table.

example: python benchmarks/search_cost.py --sources redkitchen --pairs 2
"""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from moving import config_of
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
CLOCKS = {"wall_s": "wall clock", "processor_s": "processor"}


@dataclass(frozen=True)
class Options:
    """Measure what the search for moving things costs where nothing moves."""

    sources: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = (
        "redkitchen", "livingroom", "cubicles", "hololens",
    )  # fmt: skip
    pairs: Annotated[int, arg(help="pairs of runs of each recording")] = 4
    limit: Annotated[int, arg(help="use at most this many frames; 0 = all")] = 0
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "search-cost"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def timed(frames: Sequence[Frame], configs: Mapping[str, Config]) -> dict[str, dict[str, float]]:
    """Run SLAM with each of two settings on the same frames, by turns; return wall-clock and processor seconds."""
    systems = {name: Slam(config) for name, config in configs.items()}
    spent = {name: dict.fromkeys(CLOCKS, 0.0) for name in configs}
    for number, frame in enumerate(frames):
        for name in sorted(systems, reverse=number % 2 == 1):
            wall_s, processor_s = time.perf_counter(), time.process_time()
            systems[name].step(frame)
            spent[name]["wall_s"] += time.perf_counter() - wall_s
            spent[name]["processor_s"] += time.process_time() - processor_s
    return spent


def measure_source(source: str, options: Options) -> dict[str, Any]:
    """Measure one recording; return the times of each pair."""
    configs = {name: config_of(options.preset, options.settings, name == "on") for name in ("off", "on")}
    recording = open_source(accuracy.located(source), configs["on"].input, limit=options.limit)
    frames, pairs = list(recording), []
    for number in range(options.pairs):
        pairs.append(timed(frames, configs))
        print(f"{source}, pair {number + 1}: {pairs[-1]}", file=sys.stderr, flush=True)
    return {"source": source, "frames": len(frames), "pairs": pairs}


def measure(options: Options) -> dict[str, Any]:
    """Measure every recording."""
    return {"recordings": [measure_source(source, options) for source in options.sources]}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the times of each recording, and their ratios."""
    head = ("recording", "frames", "clock", "off, s", "on, s", "on / off by pair, median (min – max)")
    rows = [
        [found["source"], str(found["frames"]), text, *_row(found["pairs"], clock)]
        for found in measured["figures"]["recordings"]
        for clock, text in CLOCKS.items()
    ]
    pairs = measured["config"]["pairs"]
    note = (
        f"Time of all frames, without the final map: medians of {pairs} pairs of runs. Each frame goes to both in turn."
    )
    return [Section("Cost of the search where nothing moves", head, rows, note)]


def _row(pairs: Sequence[dict[str, Any]], clock: str) -> list[str]:
    off, on = (np.array([pair[which][clock] for pair in pairs]) for which in ("off", "on"))
    ratios = on / off
    spread = " – ".join(f"{x:.3f}" for x in (ratios.min(), ratios.max()))
    medians = [significant(float(np.median(x))) for x in (off, on)]
    return [*medians, f"{np.median(ratios):.3f} ({spread})"]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("search_cost", options, measure)


if __name__ == "__main__":
    program.start(main, Options)
