"""One row of board.py: run a recording with the command line of a checkout, read its clock, score its run folder."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import accuracy
import board_scores
import cv2
import numpy as np
import plain
import robustness_scores
import torch
from disturbances import plan
from disturbed_recordings import FRAMES_PER_SECOND, original, write

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.native.threads import set_kernel_threads

ONE_THREAD = {"SIGMASPLAT_THREADS": "1", "OMP_NUM_THREADS": "1"}
SETTINGS = ("final.iterations=0",)
"""Settings of every run; the board looks at tracking and submaps, so there is no refinement of the final map."""
EVENT_SEED = 0
"""Seed of what is disturbed: the same for all seeds of the runs, so that these show the noise of SLAM alone."""
VERSION = 1
"""Results of another version are not comparable: to be raised with any change of what a figure means."""
COST_S = {
    "hololens": 180.0, "fr1_xyz": 100.0, "room, noisy": 90.0, "corridor": 80.0, "redkitchen": 80.0, "livingroom": 55.0,
    "cabinet58": 50.0, "livingroom, 8 × faster": 30.0, "fr1_xyz, big object": 40.0,
}  # fmt: skip
"""About how long a row runs; long ones start first, so that both processes end together."""
POLL_S, TIMEOUT_S = 0.05, 1800.0


@dataclass(frozen=True)
class Row:
    """What is run: a recording by name or path, its first `limit` frames (0 = all) from start_s on, and how its frames
    are disturbed (`disturbances.plan`); "" = not at all."""

    name: str
    source: str
    disturbance: str = ""
    severity: int = 0
    frames: int = 0
    limit: int = 0
    start_s: float = 0.0

    def key(self, seed: int) -> str:
        """Return the key of a result: all that changes it besides the code."""
        digest = sha256(json.dumps([asdict(self), SETTINGS, VERSION]).encode()).hexdigest()[:8]
        return f"{self.name}, seed {seed}, {digest}"


def named(names: Sequence[str], rows: Sequence[Row]) -> list[Row]:
    """Return the rows with these names. Raises ConfigError for an unknown name."""
    known = {row.name: row for row in rows}
    for name in names:
        if name not in known:
            raise ConfigError(f"no row {name!r}; there are {', '.join(map(repr, known))}")
    return [known[name] for name in names]


def environment(checkout: Path) -> dict[str, str]:
    """Return the environment in which Python imports from a checkout and computes with one thread."""
    tools = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout / "src"), "PATH": tools}


def one_thread() -> None:
    """Let the calling thread score without the help of others."""
    torch.set_num_threads(1)
    set_kernel_threads(1)
    cv2.setNumThreads(1)


def perform(row: Row, seed: int, checkout: Path | None, scratch: Path) -> dict[str, Any]:
    """Run a row with the code of a checkout, or with the plain system (None), and score it; `problem` says why that
    failed."""
    start = time.perf_counter()
    with TemporaryDirectory(dir=scratch) as folder:
        try:
            scored = run_disturbed if row.disturbance else run_recording
            result = {"problem": None} | scored(row, seed, checkout, Path(folder))
        except (SigmaSplatError, OSError, ValueError, KeyError, subprocess.SubprocessError) as problem:
            result = {"problem": f"{type(problem).__name__}: {problem}"[:300]}
    return result | {"wall_s": round(time.perf_counter() - start, 2)}


def run_recording(row: Row, seed: int, checkout: Path | None, folder: Path) -> dict[str, Any]:
    """Run a recording as it is; return its figures."""
    path, limit = accuracy.located(row.source), ["--limit", str(row.limit)] if row.limit else []
    if checkout is None:
        return plain.run(path, row.limit)
    cpu_s = run([path, "--seed", str(seed), *limit], checkout, folder)
    return board_scores.score(folder / "run", path, row.limit) | {"cpu_s": cpu_s}


def run_disturbed(row: Row, seed: int, checkout: Path | None, folder: Path) -> dict[str, Any]:
    """Write a disturbed recording without truth and run it; return its figures."""
    from_ = original(accuracy.located(row.source), row.start_s, folder / "frames", row.limit)
    planned = plan(row.disturbance, row.severity, EVENT_SEED, row.frames, len(from_))
    write(from_, planned, row.disturbance, row.severity, EVENT_SEED, folder / "recording")
    if checkout is None:
        times_s = np.arange(len(planned)) / FRAMES_PER_SECOND
        return plain.run(str(folder / "recording"), 0, Trajectory(times_s, from_.T_world_camera[planned.color]))
    cpu_s = run([str(folder / "recording"), "--seed", str(seed)], checkout, folder)
    shown = [planned.color] + [planned.depth] * bool((planned.depth != planned.color).any())
    read = robustness_scores.read_run(folder / "run", len(planned))
    found = robustness_scores.score(read, from_.T_world_camera[np.stack(shown)], planned)
    return {name: found[name] for name in ("frames", "ate_m", "lost", "silent")} | {"cpu_s": cpu_s}


def run(words: Sequence[str], checkout: Path, folder: Path) -> float | None:
    """Run SLAM into folder/run; return the processor time of a frame, s. Raises ValueError with the last line if it
    fails."""
    command = [sys.executable, "-m", "sigmasplat", "run", *words, "--out", str(folder / "run")]
    command += ["--no-eval", "--save-every", "0", *(word for s in SETTINGS for word in ("--set", s))]
    with (folder / "output.txt").open("w") as output:
        process = subprocess.Popen(command, env=environment(checkout), stdout=output, stderr=subprocess.STDOUT)
        try:
            cpu_s = frame_seconds(process, folder / "run" / "log.jsonl")
        finally:
            process.kill()  # only if this process was stopped: otherwise it has ended
            process.wait()
    if process.returncode:
        lines = (folder / "output.txt").read_text(errors="replace").strip().splitlines()
        raise ValueError(lines[-1] if lines else f"exit code {process.returncode}")
    return cpu_s


def frame_seconds(process: subprocess.Popen[Any], log: Path) -> float | None:
    """Wait for a run; return the processor time between the lines of its first and its last frame, s per frame.

    So start, first frame and end of the run do not count. None with fewer than 2 lines. Raises TimeoutExpired.
    """
    marks, size, deadline = list[tuple[int, float]](), 0, time.monotonic() + TIMEOUT_S
    while process.poll() is None:
        if time.monotonic() > deadline:
            raise subprocess.TimeoutExpired(process.args, TIMEOUT_S)
        if log.is_file() and log.stat().st_size > size:
            spent = processor_seconds(process.pid)
            text = log.read_bytes()
            size = len(text)
            if spent is not None and (lines := text.count(b"\n")):
                marks = [*marks[:1], (lines, spent)]
        time.sleep(POLL_S)
    if len(marks) < 2 or marks[1][0] == marks[0][0]:
        return None
    return (marks[1][1] - marks[0][1]) / (marks[1][0] - marks[0][0])


def processor_seconds(pid: int) -> float | None:
    """Return the user and system time of a process with all its threads, s; None if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
