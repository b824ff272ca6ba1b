"""Measure how well a sensor is measured: its times between halves of recordings, and after depth was moved in time; its
times and its camera in random rooms.

Pairs of keyframes are those of `sigmasplat calibrate`; each half of a recording has half of its pairs. Moved depth: the
stamps of depth are moved by an offset that the measurement is not told. Random rooms are synthetic recordings with
noise, changing exposure, and faults that are drawn evenly; `calibrate` measures them.
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

from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.errors import SourceError
from sigmasplat.graph.sensor_fit import TIMES, Pair, fitted
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.calibrate import aligned_pairs, measure_sensor
from sigmasplat.types import completed

arg = tyro.conf.arg
NAMES = ("depth after colour, ms", "depth rows, ms", "colour rows, ms")
CAMERA = (
    "focal length, %", "centre to the right, % of the width", "centre down, % of the width", "inverse depth, 1/100 m",
    "fall-off, %",
)  # fmt: skip
MOST = 120
"""Pairs of one measurement with moved depth: every second one of those of `calibrate`."""
LATE_MS, ROWS_MS = 30.0, 35.0
"""Drawn times: depth is at most so much early or late; rows take between nothing and so long."""
FOCAL, CENTER_PX, OFFSET, FALLOFF = 0.02, 5.0, 0.01, 0.4
"""Drawn faults of the stated camera: at most so much to both sides; fall-off is between nothing and so much."""


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
    fit = completed(fitted(pairs, TIMES))
    found: dict[str, Any] = {"pairs": len(pairs), "sure": fit.sure, "ms": None, "std_ms": None}
    if fit.std is None:
        return found
    return found | {"ms": (1e3 * fit.values).tolist(), "std_ms": (1e3 * fit.std).tolist()}


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
        rooms.append({"seed": number} | room(options.frames, number, random, config))
        print(rooms[-1], file=sys.stderr, flush=True)
    return {"recordings": recordings, "moved": offsets, "rooms": rooms}


def room(frames: int, seed: int, random: np.random.Generator, config: Config) -> dict[str, Any]:
    """Return the true errors of a random room's sensor, and those that `calibrate` measures with their standard
    deviations, None where it is not clear: three times, then the five of `CameraErrors`."""
    true_ms = random.uniform((-LATE_MS, 0.0, 0.0), (LATE_MS, ROWS_MS, ROWS_MS)).round(1)
    most = np.array([FOCAL, CENTER_PX, CENTER_PX, OFFSET])
    focal, x, y, offset, falloff = (float(v) for v in random.uniform([*-most, 0.0], [*most, FALLOFF]).round(4))
    names = ("late", "depth_rows", "rows", "focal", "center_x", "center_y", "depth_offset", "falloff")
    faults = zip(names, [*(true_ms / 1e3).tolist(), focal, x, y, offset, falloff], strict=True)
    text = ",".join(
        [f"frames={frames},width=320,height=240,noise=1,seed={seed},exposure=0.2"] + [f"{n}={v:.6g}" for n, v in faults]
    )
    true = [
        *true_ms.tolist(),
        *(100.0 * np.array([1 / (1 + focal) - 1, -x / 320, -y / 320, -offset, falloff])).tolist(),
    ]
    try:
        found = measure_sensor(open_source(f"synthetic:{text}"), config)
    except SourceError:
        return {"true": true, "found": None, "std": None}
    times, camera = found.estimate, found.camera
    ms = [1e3 * t for t in (times.depth_late_s, times.depth_rows_s, times.color_rows_s)]
    std = [*(1e3 * s for s in times.std_s or (0.0,) * 3), *(100.0 * s for s in camera.std or (1.0,) * 5)]
    return {"true": true, "found": [*ms, *(100.0 * v for v in camera.values)], "std": std}


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
    known = [room for room in figures["rooms"] if room["found"] is not None]
    found, true, std = (np.array([room[key] for room in known]).reshape(-1, 8) for key in ("found", "true", "std"))
    errors = found - true
    rooms = [
        [name, f"{np.median(np.abs(e)):.2f}", f"{np.abs(e).max():.2f}", f"{np.median(s):.2f}",
         f"{100 * (np.abs(e) < 2 * s).mean():.0f} %"]
        for name, e, s in zip(NAMES + CAMERA, errors.T, std.T, strict=True)
    ] if known else []  # fmt: skip
    note = f"{len(known)} of {len(figures['rooms'])} rooms tell; in the others nothing is corrected. 320 pixels wide."
    return [
        Section("Recordings", ("recording", "part", "pairs", *NAMES), recordings),
        Section("Depth moved in time", ("recording", "moved by, ms", "found, ms"), offsets),
        Section("Random rooms", ("quantity", "median error", "largest", "median σ", "within 2 σ"), rooms, note),
    ]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("sensor_times", options, measure)


if __name__ == "__main__":
    program.start(main, Options)
