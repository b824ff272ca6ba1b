"""Disturb recordings and measure what tracking makes of them: errors, lost frames, silent failures, recovery.

Sequences × disturbances × severities × seeds; each run is a process with one thread and sees a recording without
ground truth. This program scores its run folder against the true path. `--command` measures another checkout.
Finished runs are read, not repeated, unless --fresh.
Writes benchmarks/results/<name>-<machine>.json and prints tables.

example: python benchmarks/robustness.py --sequences livingroom --disturbances black --seeds 0
"""

import json
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import cv2
import numpy as np
import program
import record
import robustness_scores as scores
import tyro
from disturbances import DISTURBANCES, plan
from disturbed_recordings import Original, original, with_truth, write

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.files.machine import INSTALLED, code_digest

arg = tyro.conf.arg
SYNTHETIC = "synthetic:frames=240,width=640,height=480,noise=1"
SEQUENCES = ("livingroom", "redkitchen", "synthetic")
START_S = {"redkitchen": 16.0}
"""Where a sequence begins: before this time the true path of redkitchen contradicts the depth by up to 10 cm."""
SETTINGS = ("input.width=240", "final.iterations=0")
"""Settings of every run. Poses of tracking are measured, so refinement of the final map is left out."""
RUNS = record.ROOT / "runs" / "robustness"
TIMEOUT_S = 900


@dataclass(frozen=True)
class Options:
    """Disturb recordings and measure what tracking makes of them: errors, lost frames, silent failures, recovery."""

    sequences: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = SEQUENCES
    disturbances: Annotated[tuple[str, ...], arg(help="which ones to apply")] = (*DISTURBANCES,)
    severities: Annotated[tuple[int, ...], arg(help="1 (weak) to 3 (strong)")] = (1, 2, 3)
    seeds: Annotated[tuple[int, ...], arg(help="seeds of runs, events and noise, one run for each")] = (0, 1, 2)
    frames: Annotated[int, arg(help="length of a disturbed recording; longer if its event needs it")] = 80
    settings: Settings = ()
    command: Annotated[str, arg(help="sigmasplat of another checkout", help_behavior_hint="(default: this one)")] = ""
    jobs: Annotated[int, arg(help="number of runs at a time, each with one thread")] = 2
    name: Annotated[str, arg(help="name of the results; use another name with another command")] = "robustness"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    collect: Annotated[bool, arg(help="run nothing, write the results of the runs that are finished")] = False
    keep: Annotated[Path | None, arg(help="keep log and errors of each frame here", help_behavior_hint="")] = None
    runs: Annotated[Path, arg(help="folder of finished runs and decoded frames")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class Job:
    """One run: what is disturbed how, and all that changes its result."""

    sequence: str
    path: str
    start_s: float
    disturbance: str
    severity: int
    seed: int
    frames: int
    settings: tuple[str, ...]
    command: str
    code: str

    @property
    def stem(self) -> str:
        """Return the name of the files of the job."""
        return f"{record.slug(self.sequence)}-{self.disturbance}-{self.severity}-seed{self.seed}"

    def words(self, recording: Path, run: Path) -> list[str]:
        """Return the command line of the run."""
        words = shlex.split(self.command) or [sys.executable, "-m", "sigmasplat.cli"]
        words += ["run", str(recording), "--seed", str(self.seed), "--out", str(run), "--no-eval", "--save-every", "0"]
        return words + [word for setting in (*SETTINGS, *self.settings) for word in ("--set", setting)]


def located(name: str) -> str:
    """Return the path of a sequence in the data folder, or the name unchanged if it is not there."""
    return SYNTHETIC if name == "synthetic" else accuracy.located(name)


def jobs_of(options: Options) -> list[Job]:
    """List the jobs, seed by seed. Raises ConfigError for an unknown disturbance or severity."""
    unknown = [name for name in options.disturbances if name not in DISTURBANCES]
    if unknown:
        raise ConfigError(f"no disturbance {unknown[0]!r}; there are {', '.join(DISTURBANCES)}")
    if not set(options.severities) <= {1, 2, 3}:
        raise ConfigError(f"severities are 1, 2 and 3, found {', '.join(map(str, options.severities))}")
    # The code of another checkout is not known here: its name and its command stand for it.
    code = options.command or code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    return [
        Job(
            Path(sequence).name, located(sequence), START_S.get(sequence, 0.0), disturbance, severity, seed,
            options.frames, options.settings, options.command, code,
        )
        for seed in options.seeds  # outermost: results of a stopped benchmark have all sequences
        for sequence in options.sequences
        for disturbance in options.disturbances
        for severity in options.severities
        if severity <= len(DISTURBANCES[disturbance].levels)
    ]  # fmt: skip


def earlier(job: Job, folder: Path) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same job with the same code; None without one."""
    try:
        result = record.read(folder / f"{job.stem}.json")
    except (OSError, ValueError):
        return None
    return result if result["job"] == json.loads(json.dumps(asdict(job))) else None


def perform(job: Job, from_: Original, folder: Path, keep: Path | None = None) -> dict[str, Any]:
    """Write the disturbed recording, run on it, score the run, write the result; `problem` says why a run failed."""
    planned = plan(job.disturbance, job.severity, job.seed, job.frames, len(from_))
    folder.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix="robustness-"))
    result: dict[str, Any] = {"job": asdict(job), "problem": None, "figures": {}, "pairs": []}
    try:
        write(from_, planned, job.disturbance, job.severity, job.seed, scratch / "recording")
        start = time.perf_counter()
        result["problem"] = call(job.words(scratch / "recording", scratch / "run"), other=bool(job.command))
        result["wall_s"] = round(time.perf_counter() - start, 2)
        if result["problem"] is None:
            run = scores.read_run(scratch / "run", len(planned))
            shown = [planned.color] + [planned.depth] * bool((planned.depth != planned.color).any())
            truth = from_.T_world_camera[np.stack(shown)]
            result["code"] = json.loads((scratch / "run" / "run.json").read_text())["code"]
            result |= {"figures": scores.score(run, truth, planned), "pairs": scores.pairs(run, truth, planned)}
            if keep:
                keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(scratch / "run" / "log.jsonl", keep / f"{job.stem}.jsonl")
                np.savez_compressed(keep / f"{job.stem}.npz", **scores.arrays(run, truth, planned))  # type: ignore[arg-type]
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    (folder / f"{job.stem}.json").write_text(json.dumps(result) + "\n")
    return result


def call(words: Sequence[str], other: bool) -> str | None:
    """Run a command of this or another checkout with one thread; return its last line if it failed."""
    environment = program.environment_of(other) | {"SIGMASPLAT_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        ended = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as problem:
        return str(problem)[:300]
    lines = [line for line in (ended.stdout + ended.stderr).splitlines() if line.strip()]
    return (lines[-1][:300] if lines else f"exit code {ended.returncode}") if ended.returncode else None


def possible(jobs: list[Job]) -> tuple[list[Job], list[str]]:
    """Return the jobs that the frames with a true pose suffice for, and one line for all that is left out.

    No image is decoded. Raises SourceError if a recording has no true pose, ConfigError if no job is possible.
    """
    available, left_out, kept = dict[tuple[str, float], int](), list[str](), list[Job]()
    for job in jobs:
        part = job.path, job.start_s
        if part not in available:
            source, _, available[part] = with_truth(*part)
            if missing := len(source) - available[part]:
                left_out.append(f"{job.sequence}: {missing} of {len(source)} frames, which have no true pose")
        try:
            plan(job.disturbance, job.severity, job.seed, job.frames, available[part])
            kept.append(job)
        except ValueError as problem:
            left_out.append(f"{job.stem}: {problem}")
    if not kept:
        raise ConfigError(f"nothing can be run: {'; '.join(left_out)}")
    return kept, left_out


def measure(options: Options) -> dict[str, Any]:
    """Run or read every job that its recording suffices for, `jobs` at a time. Raises SigmaSplatError if there is none,
    or a recording cannot be read."""
    cv2.setNumThreads(1)
    folder = options.runs / options.name
    listed, left_out = (jobs_of(options), []) if options.collect else possible(jobs_of(options))
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr, flush=True)
    parts = [] if options.collect else sorted({(job.path, job.start_s) for job in listed})
    originals = {part: original(*part, options.runs / "frames") for part in parts}

    def work(numbered: tuple[int, Job]) -> dict[str, Any] | None:
        number, job = numbered
        found = None if options.fresh else earlier(job, folder)
        if options.collect or (found and found["problem"] is None):
            return found
        result = perform(job, originals[job.path, job.start_s], folder, options.keep)
        how = result["problem"] or f"{result['wall_s']:.0f} s, {said(result['figures'])}"
        print(f"[{number}/{len(listed)}] {job.stem}: {how}", file=sys.stderr, flush=True)
        return result

    with ThreadPoolExecutor(options.jobs) as pool:
        found = [result for result in pool.map(work, enumerate(listed, 1)) if result]
    return figures_of(found) | {"left_out": left_out}


def said(figures: dict[str, Any]) -> str:
    """Return the main figures of a run as text."""
    ate = "–" if figures["ate_m"] is None else f"{100 * figures['ate_m']:.1f} cm"
    return f"ATE {ate}, {figures['lost']} lost and {figures['silent']} silent of {figures['frames']}"


def figures_of(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is recorded of all runs: the figures of each, and the scores of p_off over all frames of all runs."""
    named = ("sequence", "disturbance", "severity", "seed")
    runs = [
        {name: result["job"][name] for name in named} | {"problem": result["problem"]} | result["figures"]
        for result in results
    ]
    every_pair = [tuple(pair) for result in results for pair in result["pairs"]]
    codes = sorted({result["code"] for result in results if result.get("code")})
    return {"measured": ", ".join(codes), "runs": runs, "p_off": scores.probability_scores(every_pair)}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("robustness", options, measure, options.seeds, refused=(SigmaSplatError, ValueError))


if __name__ == "__main__":
    program.start(main, Options)
