"""Define an executor, which makes the runs of a batch. `local` and `cluster` are the two executors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from sigmasplat.errors import ConfigError, SigmaSplatError
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
