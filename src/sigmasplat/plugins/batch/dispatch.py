"""Give runs to the workers of a Dask cluster that have their sequences, while workers leave and join.

Every thread of a worker has one run at a time. Which worker makes a run is chosen here and not by Dask: Dask would wait
without limit for a worker that has left, and would give runs to a worker that joined without their sequence.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sigmasplat.errors import RunError
from sigmasplat.plugins.batch.executor import Outcome
from sigmasplat.plugins.batch.job import Job

POLL_S = 1.0
"""Time between two looks at the list of workers."""
REJOIN_S = 60.0
"""A sequence is missing if for this time no worker has it."""
DEATHS = 4
"""A run whose worker dies this many times is given up: the workers may not have enough memory for it."""


@dataclass(frozen=True)
class Worker:
    """A worker: its name, and the names of the jobs whose sequence it has."""

    name: str
    jobs: frozenset[str]


class Dispatch:
    """Makes runs on workers that come and go.

    workers: the known workers by address; new ones are added. look: returns the workers at some addresses, without
    those that do not answer. submit: starts a job on the worker at an address and returns its future. fetch: returns
    why a job failed, None if it did not; raises TimeoutError if the result is lost. say: prints a line.
    """

    def __init__(
        self,
        client: Any,
        workers: Mapping[str, Worker],
        look: Callable[[Sequence[str]], Mapping[str, Worker]],
        submit: Callable[[Job, str], Any],
        fetch: Callable[[Any, Job], str | None],
        say: Callable[[str], None],
    ) -> None:
        self.client, self.workers = client, dict(workers)
        self.look, self.submit, self.fetch, self.say = look, submit, fetch, say
        self.waiting = list[Job]()
        self.running = dict[Any, tuple[Job, str]]()
        self.deaths = dict[str, int]()
        self.without_since_s = dict[tuple[str, ...], float]()
        self.empty = False
        self.changed = threading.Event()

    def make(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Make the runs; yield each job when it ends. Raises RunError if the scheduler no longer answers."""
        self.waiting = list(jobs)
        try:
            while self.waiting or self.running:
                threads = self._threads()
                self.workers |= self.look([address for address in threads if address not in self.workers])
                yield from self._left_by_dead(threads)
                yield from self._without_worker(threads)
                self._hand_out(threads)
                yield from self._ended()
        finally:
            self.client.cancel(list(self.running), force=True)

    def _threads(self) -> dict[str, int]:
        """Return the number of threads of each worker, by its address."""
        try:
            return dict(self.client.nthreads())
        except (OSError, TimeoutError) as problem:
            raise RunError("the Dask scheduler no longer answers; start it again and repeat the command") from problem

    def _left_by_dead(self, threads: Mapping[str, int]) -> Iterator[Outcome]:
        """Take back the runs of workers that have left."""
        for future, (job, address) in list(self.running.items()):
            if address in threads or future.done():
                continue
            self.client.cancel([future], force=True)
            del self.running[future]
            self.deaths[job.name] = self.deaths.get(job.name, 0) + 1
            if self.deaths[job.name] < DEATHS:
                self.waiting.insert(0, job)
            else:
                yield Outcome(job, f"its worker died {DEATHS} times; is there enough memory?")

    def _without_worker(self, threads: Mapping[str, int]) -> Iterator[Outcome]:
        """Print which sequences no worker has any more, and give their runs up after `REJOIN_S`."""
        if not threads:
            if not self.empty:
                self.say("no worker is left; waiting for a worker")
            self.empty = True
            self.without_since_s.clear()
            return
        self.empty = False
        without = [
            job for job in self.waiting if not any(job.name in self.workers[a].jobs for a in self._known(threads))
        ]
        for paths in set(self.without_since_s) - {job.paths for job in without}:
            del self.without_since_s[paths]
        for job in without:
            had = sorted({worker.name for worker in self.workers.values() if job.name in worker.jobs})
            scene, names = job.paths[0], " and worker ".join(had)
            if job.paths not in self.without_since_s:
                self.without_since_s[job.paths] = time.monotonic()
                self.say(
                    f"{scene}: worker {names} had it and left; waiting {REJOIN_S:.0f} s for another worker that has it"
                )
            elif time.monotonic() - self.without_since_s[job.paths] > REJOIN_S:
                self.waiting.remove(job)
                yield Outcome(job, f"{scene}: worker {names} had it and left", missing=True)

    def _hand_out(self, threads: Mapping[str, int]) -> None:
        """Give each free thread a run, one worker after the other."""
        busy = [address for _, address in self.running.values()]
        free = {address: threads[address] - busy.count(address) for address in self._known(threads)}
        given = True
        while given:
            given = False
            for address in free:
                job = next((job for job in self.waiting if job.name in self.workers[address].jobs), None)
                if job and free[address] > 0:
                    self.waiting.remove(job)
                    future = self.submit(job, address)
                    future.add_done_callback(lambda _: self.changed.set())
                    self.running[future] = job, address
                    free[address] -= 1
                    given = True

    def _known(self, threads: Mapping[str, int]) -> list[str]:
        return [address for address in threads if address in self.workers]

    def _ended(self) -> Iterator[Outcome]:
        """Wait until a run ends, at most `POLL_S`; yield the runs that have ended."""
        self.changed.wait(POLL_S)
        self.changed.clear()
        for future in [future for future in self.running if future.done()]:
            job, _ = self.running.pop(future)
            try:
                yield Outcome(job, self.fetch(future, job))
            except TimeoutError:  # the worker left with the result
                self.waiting.insert(0, job)
