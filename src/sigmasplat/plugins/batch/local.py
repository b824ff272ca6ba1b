"""Make runs on this machine, some at a time, each in a process of its own."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from sigmasplat.files.machine import usable_cores
from sigmasplat.plugins.batch.executor import Outcome, Sequences, sequences_of
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.batch.process import RunProcesses

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
