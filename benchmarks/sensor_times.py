"""Measure how well the times of a sensor are found: between halves of recordings, after depth was moved in time, and in
random rooms.

Pairs of keyframes are those of `sigmasplat calibrate`; each half of a recording has half of its pairs. Moved depth: the
stamps of depth are moved by an offset that the measurement is not told. Random rooms are synthetic recordings with
noise; late depth and the rows of both images are drawn evenly.
Writes benchmarks/results/sensor-times-<machine>.json and prints tables.

example: python benchmarks/sensor_times.py --sources fr1_xyz --rooms 2
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from tables import Section

from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.graph.sensor_times import Pair, estimated
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.calibrate import aligned_pairs
from sigmasplat.types import completed

arg = tyro.conf.arg
NAMES = ("depth after colour, ms", "depth rows, ms", "colour rows, ms")
MOST = 120
"""Pairs of one measurement with moved depth: every second one of those of `calibrate`."""
LATE_MS, ROWS_MS = 30.0, 35.0
"""Drawn times: depth is at most so much early or late; rows take between nothing and so long."""


@dataclass(frozen=True)
class Options:
    """Measure the times of sensors, and how far their standard deviations can be trusted."""

    sources: Annotated[tuple[str, ...], arg(help="recordings")] = (
        "fr1_xyz", "redkitchen", "hololens", "livingroom", "cubicles", "cabinet58",
    )  # fmt: skip
    moved_ms: Annotated[tuple[int, ...], arg(help="offsets of the stamps of depth")] = (-33, -20, -10, 10, 20, 33)
    rooms: Annotated[int, arg(help="number of random rooms")] = 40
    frames: Annotated[int, arg(help="frames of a random room")] = 80
    limit: Annotated[int | None, arg(help="frames of a recording at most", help_behavior_hint="(default: all)")] = None
    name: Annotated[str, arg(help="name of the results")] = "sensor-times"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def found_in(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return the times [3] of some pairs in ms with their standard deviations, and whether they are sure not to be 0;
    None where the pairs do not tell."""
    times, sure = completed(estimated(pairs))
    found: dict[str, Any] = {"pairs": len(pairs), "sure": sure, "ms": None, "std_ms": None}
    if times.std_s is None:
        return found
    ms = [1e3 * t for t in (times.depth_late_s, times.depth_rows_s, times.color_rows_s)]
    return found | {"ms": ms, "std_ms": [1e3 * std_s for std_s in times.std_s]}


def moved(pairs: Sequence[Pair], offset_s: float) -> list[Pair]:
    """Return pairs whose depth is stamped later than it was."""
    return [
        pair._replace(
            of_reference=replace(pair.of_reference, late_s=pair.of_reference.late_s + offset_s),
            of_live=replace(pair.of_live, late_s=pair.of_live.late_s + offset_s),
        )
        for pair in pairs
    ]


def measure(options: Options) -> dict[str, Any]:
    """Measure every recording and every room."""
    config, recordings, offsets, rooms = preset(default_preset()), [], [], []
    for name in options.sources:
        pairs = aligned_pairs(open_source(accuracy.located(name), limit=options.limit or 0), config)
        parts = {"all": pairs, "first half": pairs[: len(pairs) // 2], "second half": pairs[len(pairs) // 2 :]}
        of_parts = {part: found_in(some) for part, some in parts.items()}
        recordings.append({"source": name, "parts": of_parts})
        print(recordings[-1], file=sys.stderr, flush=True)
        few = pairs[:: -(-len(pairs) // MOST)] if pairs else []
        still = found_in(few)
        for offset_ms in options.moved_ms if still["ms"] else ():
            found = found_in(moved(few, offset_ms / 1e3))
            offsets.append({"source": name, "moved_ms": offset_ms, "still": still} | found)
            print(offsets[-1], file=sys.stderr, flush=True)
    random = np.random.default_rng(0)
    for number in range(options.rooms):
        true_ms = [float(t) for t in random.uniform((-LATE_MS, 0.0, 0.0), (LATE_MS, ROWS_MS, ROWS_MS)).round(1)]
        late, depth_rows, rows = (f"{t / 1e3:g}" for t in true_ms)
        room = f"synthetic:frames={options.frames},width=320,height=240,noise=1,seed={number}"
        pairs = aligned_pairs(open_source(f"{room},late={late},depth_rows={depth_rows},rows={rows}"), config)
        rooms.append({"seed": number, "true_ms": true_ms} | found_in(pairs))
        print(rooms[-1], file=sys.stderr, flush=True)
    return {"recordings": recordings, "moved": offsets, "rooms": rooms}


# ---- tables ----


def said(found: dict[str, Any]) -> list[str]:
    """Return three times in words."""
    if found["ms"] is None:
        return ["not clear"] * 3
    mark = "" if found["sure"] else " (0 not refuted)"
    return [f"{t:.1f} ± {s:.1f}{mark}" for t, s in zip(found["ms"], found["std_ms"], strict=True)]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate recordings, moved depth, and the errors in random rooms."""
    figures = measured["figures"]
    recordings = [
        [r["source"], part, str(found["pairs"]), *said(found)]
        for r in figures["recordings"]
        for part, found in r["parts"].items()
    ]
    offsets = [
        [m["source"], f"{m['moved_ms']:+d}", f"{m['still']['ms'][0] - m['ms'][0]:+.1f}" if m["ms"] else "not clear"]
        for m in figures["moved"]
    ]
    known = [room for room in figures["rooms"] if room["ms"] is not None]
    errors, std = (np.array([room[key] for room in known]).reshape(-1, 3) for key in ("ms", "std_ms"))
    errors = errors - np.array([room["true_ms"] for room in known]).reshape(-1, 3)
    rooms = [
        [name, f"{np.median(np.abs(e)):.1f}", f"{np.abs(e).max():.1f}", f"{np.median(s):.1f}",
         f"{100 * (np.abs(e) < 2 * s).mean():.0f} %"]
        for name, e, s in zip(NAMES, errors.T, std.T, strict=True)
    ] if known else []  # fmt: skip
    note = f"{len(known)} of {len(figures['rooms'])} rooms tell their times; in the others nothing is corrected."
    return [
        Section("Recordings", ("recording", "part", "pairs", *NAMES), recordings),
        Section("Depth moved in time", ("recording", "moved by, ms", "found, ms"), offsets),
        Section("Random rooms", ("time", "median error", "largest", "median σ", "within 2 σ"), rooms, note),
    ]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("sensor_times", options, measure)


if __name__ == "__main__":
    program.start(main, Options)
