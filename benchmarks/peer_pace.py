"""Measure the time per frame of SigmaSplat and of other RGB-D systems on the same frames, one system after the other.

SigmaSplat runs in turn, which also gives the time of its tracking alone, and with --realtime. Open3D and ORB-SLAM3 run
in a Python of their own (--open3d, --orbslam3); without it they are left out. The calls that return poses are timed,
and the frames together: frames/s, cores in use, processor time. Linux only.
Writes benchmarks/results/peer-pace-<machine>.json, prints tables.

example: python benchmarks/peer_pace.py --open3d ../peers/bin/python --sequences redkitchen --rounds 3
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import numpy as np
import pace
import peers
import program
import realtime
import record
import tyro
from peer_clock import SECONDS, TOTALS
from peers import OtherSystems, Peer, Result, pythons_of
from tables import Section, significant

from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
QUICK_FRAMES, WATCHED_EVERY_S = 60, 0.02
IN_TURN, TRACKING, REALTIME = "SigmaSplat, `sigma`", "… its tracking alone", "SigmaSplat, `--realtime` ‡"
SLOW_PEER, CAMERA_PEER = "ORB-SLAM3, half a second per frame", "ORB-SLAM3 ‡"
PEERS = (
    *(peer for peer in peers.PEERS if peer.package == "open3d"),
    Peer(SLOW_PEER, "orbslam3"),
    Peer(CAMERA_PEER, "orbslam3", more=("camera",)),
)
SYSTEMS = (IN_TURN, TRACKING, REALTIME, *(peer.name for peer in PEERS))
MAPS = {
    IN_TURN: "splats", TRACKING: "none", REALTIME: "splats", SLOW_PEER: "sparse points", CAMERA_PEER: "sparse points",
    **{peer.name: "TSDF" if "dense" in peer.name else "none" for peer in PEERS if peer.package == "open3d"},
}  # fmt: skip
QUOTED: tuple[Result, ...] = tuple(
    {"system": "RTAB-Map †", "sequence": name, "frames_per_s": "15–23", "cores": "1", "map": "point cloud, grid"}
    for name in ("redkitchen", "livingroom")
)
"""Figures that are not measured by this program."""
FIGURES = ("median_ms", "p99_ms", "frames_per_s", "cores", "processor_ms", "without_pose", "ate_m", "final_s")
"""Figures of a run, each None if it is not known or has no meaning for the system."""


@dataclass(frozen=True)
class Options(OtherSystems):
    """Measure the time per frame of SigmaSplat and of other RGB-D systems on the same frames."""

    sequences: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = ("redkitchen", "livingroom")
    rounds: Annotated[int, arg(help="runs of each system, by turns")] = 1
    quick: Annotated[bool, arg(help=f"{QUICK_FRAMES} frames, once; no results written", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "peer-pace"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def times_of(calls_s: Sequence[float], times_s: Sequence[float]) -> Result:
    """Return median and 99 % of the calls, ms, without the first second; of shorter recordings without frame 0."""
    counted = realtime.settled(times_s)
    later = list(compress(calls_s, counted if any(counted) else [i > 0 for i in range(len(times_s))]))
    return {"median_ms": 1e3 * float(np.median(later)), "p99_ms": 1e3 * float(np.percentile(later, 99))}


# ---- SigmaSplat ----


def processor_s(process: int) -> float:
    """Return the processor time of all threads of a process so far."""
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def watched(command: Sequence[str], folder: Path, output: Path) -> tuple[float, float]:
    """Make a run; return wall and processor time from the first line of its log to the last one.

    Raises SigmaSplatError with the last line of its output if it fails, and if it is too short to be watched.
    """
    log, seen = folder / "log.jsonl", list[tuple[int, float, float]]()
    with output.open("w") as file:
        run = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
    while run.poll() is None:
        size = log.stat().st_size if log.exists() else 0
        if size and (not seen or size > seen[-1][0]):
            seen.append((size, time.perf_counter(), processor_s(run.pid)))
        time.sleep(WATCHED_EVERY_S)
    if run.returncode:
        lines = [line for line in output.read_text(errors="replace").splitlines() if line.strip()]
        raise SigmaSplatError((lines or ["no message"])[-1])
    if len(seen) < 2:
        raise SigmaSplatError(f"the run ends within {WATCHED_EVERY_S} s: too short to be measured")
    return seen[-1][1] - seen[0][1], seen[-1][2] - seen[0][2]


def run_ours(path: str, options: Options, scratch: Path, *more: str) -> list[Result]:
    """Run SigmaSplat on a sequence; return the figures of the run, and of its tracking alone if it runs in turn."""
    with TemporaryDirectory(dir=scratch) as new:
        folder = Path(new) / "run"
        words = [sys.executable, "-m", "sigmasplat.cli", "run", path, "--out", str(folder), "--no-eval", *more]
        words += [] if options.limit is None else ["--limit", str(options.limit)]
        wall_s, used_s = watched(words, folder, Path(new) / "output.txt")
        run = RunFolder.open(folder)
        found = peers.score(read_poses(folder / "trajectory.txt"), open_source(path), options.limit)
        return ours_of(run.read_log(), run.facts(), wall_s, used_s, found)


def ours_of(log: list[Any], facts: Result, wall_s: float, used_s: float, found: Result) -> list[Result]:
    """Return the figures of a run from its log, its run.json, its times while it was watched, and its score."""
    times_s, seconds = [line["timestamp_s"] for line in log], [line["seconds"] for line in log]
    speed = pace.figures_of([s["total"] for s in seconds], facts)
    common = {"problem": None, **found, "frames_per_s": speed["frames_per_s"], "final_s": speed["final_s"]}
    common |= {"cores": used_s / wall_s, "processor_ms": 1e3 * used_s / (len(log) - 1)}
    if facts.get("realtime"):
        latencies_s = [s["latency"] for s in seconds]
        return [{"system": REALTIME, **common, **times_of(latencies_s, times_s), "dropped": facts["dropped"]}]
    tracking_s = [s.get("prepare", 0.0) + s.get("track", 0.0) for s in seconds]  # frame 0 is not tracked
    alone = {"system": TRACKING, "problem": None, "frames_per_s": len(log) / sum(tracking_s)}
    return [
        {"system": IN_TURN, **common, **times_of([s["total"] for s in seconds], times_s)},
        {**alone, **times_of(tracking_s, times_s)},
    ]


# ---- other systems ----


def run_peer(peer: Peer, path: str, options: Options, frames: Path, python: Path) -> Result:
    """Run another system on the frames in a folder. Raises SigmaSplatError if it fails."""
    result = peers.run_peer(peer, Path(path).name, path, frames, options, python)
    if result["problem"] is not None:
        raise SigmaSplatError(f"{peer.name}: {result['problem']}")
    times_s, calls_s = (np.load(frames / name).tolist() for name in ("times.npy", SECONDS))
    totals = json.loads((frames / TOTALS).read_text())
    return result | peer_figures(peer, times_s, calls_s, totals)


def peer_figures(peer: Peer, times_s: Sequence[float], calls_s: Sequence[float], totals: dict[str, float]) -> Result:
    """Return the figures of another system from what its clock has written.

    Half a second per frame is for the threads that map: neither frames/s nor cores have a meaning then.
    """
    used_s, paced = totals["later_processor_s"], peer.name != SLOW_PEER
    return {
        **times_of(calls_s, times_s),
        "frames_per_s": len(calls_s) / totals["wall_s"] if paced else None,
        "cores": used_s / totals["later_wall_s"] if paced else None,
        "processor_ms": 1e3 * used_s / (len(calls_s) - 1),
    }


# ---- all ----


def systems_of(path: str, options: Options, scratch: Path) -> Iterator[Result]:
    """Measure every system once on a sequence, the others first: a package that is missing is noticed early."""
    pythons = pythons_of(options)
    for peer in PEERS:
        if python := pythons[peer.package]:
            yield run_peer(peer, path, options, scratch, python)
    yield from run_ours(path, options, scratch)
    yield from run_ours(path, options, scratch, "--realtime")


def measure(options: Options) -> dict[str, Any]:
    """Measure every sequence. Raises SigmaSplatError or OSError if a system fails."""
    if options.limit is not None and options.limit < 2:
        raise ConfigError(f"--limit {options.limit}: at least two frames are needed")
    runs = []
    for sequence in options.sequences:
        path, name = accuracy.located(sequence), Path(sequence).name
        with TemporaryDirectory(prefix="peer-pace-") as scratch:
            if any(pythons_of(options).values()):
                peers.write_frames(open_source(path), options.limit, Path(scratch))
            for number in range(options.rounds):
                for result in systems_of(path, options, Path(scratch)):
                    result |= {"source": name, "round": number}
                    shown = f"{result['system']}: {result['median_ms']:.1f} ms"
                    print(f"{name}, round {number}, {shown}", file=sys.stderr, flush=True)
                    runs.append(result)
    names = {run["source"] for run in runs}
    return {"runs": runs, "quoted": [figure for figure in QUOTED if figure["sequence"] in names]}


# ---- tables ----

NOTE = (
    "Medians over the runs of each system. Milliseconds: of the call that returns the pose, from the decoded image, "
    "without the first second; SigmaSplat in turn maps its keyframes within it, `--realtime` is from the arrival of "
    "the image to its pose. Frames/s: all frames, with what a system does between two calls; SigmaSplat decodes the "
    "files of the recording too, the others read decoded images. Tracking alone: the stages `prepare` and `track` of "
    "the same run. Cores: processor time by wall time, from the second frame on. SigmaSplat works at 320 pixels width, "
    "the others at full size. Final map: time after the last frame. ‡ At the times of the frames: it waits for them, "
    "so that frames/s are the camera's if it keeps up. Half a second per frame, as in `peers.py`: the threads of "
    "ORB-SLAM3 that map have time to keep up; frames/s would be those of the waiting. † Not measured by this command: "
    "the issue that asks for this comparison gives it for RTAB-Map-like systems on these frames, "
    "measured earlier by the project's founders on one core."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table for each sequence: a row for each system, those quoted last. The note is below the last one."""
    runs, quoted = measured["figures"]["runs"], measured["figures"]["quoted"]
    head = ["system", "median, ms", "99 %, ms", "frames/s", "cores", "processor time per frame, ms"]
    head += ["frames without a pose", "ATE, cm", "final map, s", "map"]
    made = []
    for sequence in dict.fromkeys(run["source"] for run in runs):
        here = [run for run in runs if run["source"] == sequence]
        by_system = {name: [run for run in here if run["system"] == name] for name in SYSTEMS}
        rows = [_row(name, found) for name, found in by_system.items() if found]
        rows += [_quoted_row(figure, len(head)) for figure in quoted if figure["sequence"] == sequence]
        made.append(Section(f"{sequence}: time per frame", head, rows))
    return [*made[:-1], *(replace(last, note=NOTE) for last in made[-1:])]


def _row(system: str, runs: list[Result]) -> list[str]:
    """Return the row of one system: the median of each figure over its runs."""
    middle = {name: _median([run[name] for run in runs if run.get(name) is not None]) for name in FIGURES}
    times = [significant(middle[name]) for name in FIGURES[:5]]
    without, ate_m = middle["without_pose"], middle["ate_m"]
    missing = "–" if without is None else f"{without:g} of {runs[0]['frames']}"
    scored = [missing, significant(None if ate_m is None else 100 * ate_m), significant(middle["final_s"])]
    return [system, *times, *scored, MAPS[system]]


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _quoted_row(figure: Result, columns: int) -> list[str]:
    """Return the row of a system that is quoted: dashes for what is not known."""
    known = [figure["system"], "–", "–", figure["frames_per_s"], figure["cores"]]
    return [*known, *["–"] * (columns - len(known) - 1), figure["map"]]


def main(options: Options) -> int:
    """Measure, write the results and print the tables; return 2 if a system fails."""
    if options.quick:
        options = replace(options, limit=options.limit or QUICK_FRAMES, rounds=1)
    given = {name: bool(python) for name, python in pythons_of(options).items()}
    given["vocabulary"] = bool(options.vocabulary)
    refused = (SigmaSplatError, OSError)
    return program.run("peer_pace", options, measure, write=not options.quick, refused=refused, **given)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
