"""Make the runs of a batch, each in a process of its own."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from sigmasplat.api import SigmaSplatError, usable_cores
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.sources import open_source

TRIES = 3
"""A run whose process is killed this many times is given up: the machine may not have enough memory for it."""
STOP_S = 120.0
"""Time for running processes to save their state after Ctrl-C."""


class Executor:
    """Makes `slots` runs at a time, with the cores divided among them.

    data: folder of the sequences; save_every_s: time between two saved states, which is what a killed run loses at
    most.
    """

    def __init__(self, data: str | None, save_every_s: float, slots: int) -> None:
        self.data, self.save_every_s, self.slots = data, save_every_s, slots
        self.stopped = False
        self.running: set[subprocess.Popen[bytes]] = set()
        self.lock = threading.Lock()

    def survey(self, jobs: Sequence[Job]) -> Mapping[str, str | None]:
        """Return what is wrong with each job's sequence, None if nothing is, by the name of the job.

        Every sequence is opened once, so that a wrong path is found now and not after hours.
        """
        opened = dict[object, str | None]()
        for job in jobs:
            key = job.paths, job.config.input
            if key not in opened:
                try:
                    open_source(job.sequence(self.data), job.config.input)
                    opened[key] = None
                except SigmaSplatError as problem:
                    opened[key] = str(problem)
        return {job.name: opened[job.paths, job.config.input] for job in jobs}

    def make(self, jobs: Sequence[Job], out: Path) -> Iterator[tuple[Job, str | None]]:
        """Make the runs in folders of `out`; yield each job when it ends, with why it failed (None: it is finished).

        If this is interrupted, running ones save their state.
        """
        with ThreadPoolExecutor(self.slots) as pool:
            try:
                made = {pool.submit(self._make, job, out / job.name): job for job in jobs}
                for future in as_completed(made):
                    yield made[future], future.result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                self._stop()
                raise

    def _make(self, job: Job, folder: Path) -> str | None:
        """Make the run of a job; return None if it is finished, else one line that says why it is not."""
        for _ in range(TRIES):
            code, said = self._wait(job, folder)
            if self.stopped:
                return "stopped"
            if code == 0:
                return None
            if code > 0:
                return said or f"the process of the run ended with exit code {code}"
        return f"the process of the run was killed {TRIES} times (signal {-code}); is there enough memory?"

    def _wait(self, job: Job, folder: Path) -> tuple[int, str]:
        """Run the process once; return its exit code and the last line that it wrote."""
        module = "sigmasplat.plugins.batch.make_run"
        command = [sys.executable, "-m", module, job.to_json(), str(folder), str(self.save_every_s)]
        command += [self.data] if self.data else []
        environment = dict(os.environ)
        if self.slots > 1 and not environment.get("SIGMASPLAT_THREADS"):
            environment["SIGMASPLAT_THREADS"] = str(max(1, usable_cores() // self.slots))
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

    def _stop(self) -> None:
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
