"""Define an executor, which makes the runs of a batch. `local` and `cluster` are the two executors."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from sigmasplat.api import ConfigError, SigmaSplatError, usable_cores
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.sources import open_source


@dataclass(frozen=True)
class Outcome:
    """How a job ended: finished, or with one line that says why it failed or why its sequence is missing."""

    job: Job
    problem: str | None = None
    missing: bool = False


class Executor(Protocol):
    """Makes runs in the folder of a batch."""

    @property
    def slots(self) -> int:
        """Return the number of runs that are made at the same time."""
        ...

    def survey(self, jobs: Sequence[Job]) -> Mapping[str, "Sequences"]:
        """Return the sequences of the jobs that each worker has, by the worker's name."""

    def make(self, jobs: Sequence[Job], out: Path) -> Iterator[Outcome]:
        """Make the runs in folders of `out`; yield each job when it ends."""


@dataclass(frozen=True)
class Sequences:
    """The sequences on one machine: numbers of frames and problems, by the name of the job."""

    frames: Mapping[str, int]
    problems: Mapping[str, str]


def sequences_of(jobs: Sequence[Job], data: str | None) -> Sequences:
    """Open every sequence once, so that a wrong path is found now and not after hours."""
    opened = dict[object, int | str]()
    for job in jobs:
        key = job.paths, job.config.input
        if key not in opened:
            opened[key] = _frames_or_problem(job, data)
    found = {job.name: opened[job.paths, job.config.input] for job in jobs}
    return Sequences(
        {name: frames for name, frames in found.items() if isinstance(frames, int)},
        {name: problem for name, problem in found.items() if isinstance(problem, str)},
    )


def _frames_or_problem(job: Job, data: str | None) -> int | str:
    try:
        return len(open_source(job.sequence(data), job.config.input))
    except SigmaSplatError as problem:
        return str(problem)


@dataclass(frozen=True)
class DataRoots:
    """The folder of the data on each worker: one for all, and others for the workers that are named."""

    everywhere: str | None = None
    by_worker: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def read(texts: Sequence[str]) -> "DataRoots":
        """Read ROOT and WORKER=ROOT as given on the command line. Raises ConfigError if ROOT is given twice."""
        pairs = [text.partition("=") for text in texts]
        named = {name: root for name, equals, root in pairs if equals and "/" not in name}
        plain = [text for text, (name, _, _) in zip(texts, pairs, strict=True) if name not in named]
        if len(plain) > 1:
            raise ConfigError(f"--data is given twice: {plain[0]} and {plain[1]}; name the worker of one: WORKER=ROOT")
        return DataRoots(plain[0] if plain else None, named)

    def of(self, *names: str) -> str | None:
        """Return the folder of the worker with one of these names."""
        return next((self.by_worker[name] for name in names if name in self.by_worker), self.everywhere)


TRIES = 3
"""A run whose process is killed this many times is given up: the machine may not have enough memory for it."""
STOP_S = 120.0
"""Time for running processes to save their state after Ctrl-C."""


class RunProcesses:
    """The processes of runs that this program has started.

    save_every_s: time between two saved states, which is what a killed run loses at most; threads: number of threads
    of each run, 0 = as the environment says.
    """

    def __init__(self, save_every_s: float, threads: int = 0) -> None:
        self.save_every_s, self.threads = save_every_s, threads
        self.stopped = False
        self.running: set[subprocess.Popen[bytes]] = set()
        self.lock = threading.Lock()

    def make(self, job: Job, folder: Path, data: str | None) -> str | None:
        """Make the run of a job in a folder; return None if it is finished, else one line that says why it is not."""
        for _ in range(TRIES):
            code, said = self._wait(job, folder, data)
            if self.stopped:
                return "stopped"
            if code == 0:
                return None
            if code > 0:
                return said or f"the process of the run ended with exit code {code}"
        return f"the process of the run was killed {TRIES} times (signal {-code}); is there enough memory?"

    def _wait(self, job: Job, folder: Path, data: str | None) -> tuple[int, str]:
        """Run the process once; return its exit code and the last line that it wrote."""
        command = [
            sys.executable,
            "-m",
            "sigmasplat.plugins.batch.make_run",
            job.to_json(),
            str(folder),
            str(self.save_every_s),
        ]
        command += [data] if data else []
        environment = dict(os.environ)
        if self.threads and not environment.get("SIGMASPLAT_THREADS"):
            environment["SIGMASPLAT_THREADS"] = str(self.threads)
        with tempfile.TemporaryFile() as errors:
            with self.lock:
                if self.stopped:
                    return 0, ""
                process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, env=environment,
                    start_new_session=True,  # Ctrl-C reaches this program only, which passes it on once
                )  # fmt: skip
                self.running.add(process)
            with process:
                code = process.wait()
            self.running.discard(process)
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
        return code, lines[-1].strip() if lines else ""

    def stop(self) -> None:
        """Interrupt all runs, so that they save their state, and wait for them; start no more."""
        with self.lock:
            self.stopped = True
            running = list(self.running)
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


THIS_MACHINE = "this machine"


class LocalExecutor:
    """Makes `slots` runs at a time, with the cores divided among them; `data` is the folder of the sequences."""

    def __init__(self, data: str | None, save_every_s: float, slots: int = 1) -> None:
        self.data, self.save_every_s, self._slots = data, save_every_s, slots

    @property
    def slots(self) -> int:
        """Return the number of runs that are made at the same time."""
        return self._slots

    def survey(self, jobs: Sequence[Job]) -> Mapping[str, Sequences]:
        """Return the sequences on this machine."""
        return {THIS_MACHINE: sequences_of(jobs, self.data)}

    def make(self, jobs: Sequence[Job], out: Path) -> Iterator[Outcome]:
        """Make the runs; if this is interrupted, running ones save their state."""
        threads = max(1, usable_cores() // self.slots) if self.slots > 1 else 0
        processes = RunProcesses(self.save_every_s, threads)
        with ThreadPoolExecutor(self.slots) as pool:
            try:
                made = {pool.submit(processes.make, job, out / job.name, self.data): job for job in jobs}
                for future in as_completed(made):
                    yield Outcome(made[future], future.result())
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                processes.stop()
                raise
