"""Make the missing runs of a batch, each in a process of its own: find their sequences, keep finished runs, and go on
after a failure."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import RunError, SigmaSplatError, usable_cores
from sigmasplat.plugins.batch.job import Job, has_other_run
from sigmasplat.plugins.sources import open_source

if TYPE_CHECKING:
    from sigmasplat.api import Screen

TRIES, STOP_S = 3, 120.0
"""A run whose process is killed this many times is given up: the machine may not have enough memory for it. Time for
running processes to save their state after Ctrl-C."""


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


@dataclass
class Batch:
    """The runs of a batch in the folder `out`, one folder per job, and what happened to them.

    missing: why a job has no sequence; failed: why its run failed; both by the name of the job.
    """

    jobs: Sequence[Job]
    out: Path
    missing: dict[str, str] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def refuse_other_runs(self, overwrite: bool) -> None:
        """Raise RunError if a folder has a run with other settings or code and may not be overwritten."""
        others = [job.name for job in self.jobs if has_other_run(job, self.out / job.name)]
        if others and not overwrite:
            raise RunError(
                f"{self.out} contains {len(others)} run{'s' * (len(others) > 1)} of other settings, other code or "
                f"other scores (first: {others[0]}); give another --out, or --overwrite to replace them"
            )

    def finished(self) -> list[Job]:
        """List the jobs whose run is complete and scored."""
        return [job for job in self.jobs if job.finished_in(self.out / job.name)]

    def make(self, executor: Executor, screen: "Screen", ended: Callable[[], object]) -> None:
        """Make the missing runs; `ended` is called after each one. A missing sequence or a failed run is one line."""
        done = self.finished()
        if done:
            screen.say(f"{len(done)} of {len(self.jobs)} runs are finished in {self.out}")
        left = list[Job]()
        found = executor.survey([job for job in self.jobs if job not in done])
        for job in (job for job in self.jobs if job.name in found):
            problem = found[job.name]
            if problem is None:
                left.append(job)
                continue
            if problem not in self.missing.values():
                screen.say(f"missing: {problem}")
            self.missing[job.name] = problem
        if not left:
            return
        with screen.counting("runs") as show:
            for count, (job, why) in enumerate(executor.make(left, self.out), 1):
                if why is not None:
                    self.failed[job.name] = why
                screen.say(f"{job.name} {'finished' if why is None else f'failed: {why}'}")
                show(count, len(left))
                ended()
