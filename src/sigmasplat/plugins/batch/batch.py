"""Make the missing runs of a batch: find their sequences, keep finished runs, and go on after a failure."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.errors import ConfigError, RunError
from sigmasplat.plugins.batch.executor import DataRoots, Executor, Outcome, Sequences
from sigmasplat.plugins.batch.job import FACT, Job, has_other_run
from sigmasplat.plugins.batch.local import LocalExecutor
from sigmasplat.plugins.batch.progress import Estimate, duration, frames_counted
from sigmasplat.run_folder.runs import RunFolder

if TYPE_CHECKING:
    from sigmasplat.run.terminal import Screen


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
                f"{self.out} contains {len(others)} runs of other settings, other code or other scores "
                f"(first: {others[0]}); give another --out, or --overwrite to replace them"
            )

    def finished(self) -> list[Job]:
        """List the jobs whose run is complete and scored."""
        return [job for job in self.jobs if job.finished_in(self.out / job.name)]

    def make(self, executor: Executor, screen: "Screen", ended: Callable[[], object]) -> None:
        """Make the missing runs; `ended` is called after each one. A missing sequence or a failed run is one line."""
        done = self.finished()
        left = [job for job in self.jobs if job not in done]
        if done:
            screen.say(f"{len(done)} of {len(self.jobs)} runs are finished in {self.out}")
        frames = self._find_sequences(executor.survey(left) if left else {}, left, screen)
        left = [job for job in left if job.name in frames]
        if not left:
            return
        estimate = Estimate(frames | {job.name: self._frames(job) for job in done}, executor.slots)
        for job in done:
            estimate.add(job, self._seconds(job))
        with (
            screen.counting("frames of all runs") as show,
            frames_counted(left, frames, self.out, show),
        ):
            waiting, started_s = list(left), time.perf_counter()
            for outcome in executor.make(left, self.out):
                waiting.remove(outcome.job)
                self._note(outcome, estimate, waiting, screen, time.perf_counter() - started_s)
                ended()

    def _note(
        self, outcome: Outcome, estimate: Estimate, waiting: Sequence[Job], screen: "Screen", elapsed_s: float
    ) -> None:
        """Print the end of a run, and the time left."""
        job, why = outcome.job, outcome.problem
        if outcome.missing:
            self._note_missing(job, why or "", screen)
            return
        count = f"[{len(self.jobs) - len(self.missing) - len(waiting)}/{len(self.jobs) - len(self.missing)}]"
        if why is not None:
            self.failed[job.name] = why
            screen.say(f"{count} {job.name} failed: {why}")
            return
        estimate.add(job, self._seconds(job))
        left_s = estimate.left_s(waiting)
        rest = f", {len(waiting)} runs left, about {duration(left_s)}" if waiting and left_s is not None else ""
        screen.say(f"{count} {job.name} finished; {duration(elapsed_s)} passed{rest}")

    def _find_sequences(
        self, surveyed: Mapping[str, Sequences], jobs: Sequence[Job], screen: "Screen"
    ) -> dict[str, int]:
        """Return the number of frames by job; print one line per sequence that no worker has."""
        frames = {name: count for sequences in surveyed.values() for name, count in sequences.frames.items()}
        for job in jobs:
            if job.name not in frames:
                self._note_missing(job, next(s.problems[job.name] for s in surveyed.values()), screen)
        return frames

    def _note_missing(self, job: Job, why: str, screen: "Screen") -> None:
        """Note that a job has no sequence; print why, once for all its jobs."""
        if why not in self.missing.values():
            screen.say(f"missing: {why}")
        self.missing[job.name] = why

    def _frames(self, job: Job) -> int:
        return int(RunFolder(self.out / job.name).read_metrics()["frames"])

    def _seconds(self, job: Job) -> float:
        """Return how long a finished run took: frames, final map and scores."""
        facts = RunFolder(self.out / job.name).facts()
        return float(sum(known or 0.0 for known in (facts["wall_s"], facts["finish_s"], facts[FACT]["scoring_s"])))


def open_executor(
    data: Sequence[str], jobs: int, scheduler: str | None, save_every_s: float, say: Callable[[str], None]
) -> Executor:
    """Return the executor of a batch: `jobs` processes on this machine, or the Dask cluster of a scheduler.

    data: folders of the sequences, ROOT or WORKER=ROOT; save_every_s: time between two saved states of a run;
    say: prints a line. Raises ConfigError.
    """
    roots = DataRoots.read(data)
    if scheduler:
        from sigmasplat.plugins.batch.cluster import ClusterExecutor

        return ClusterExecutor(scheduler, roots, save_every_s, say)
    if jobs < 1:
        raise ConfigError(f"--jobs must be at least 1, found {jobs}")
    if roots.by_worker:
        raise ConfigError(f"--data names the worker {next(iter(roots.by_worker))}, which needs --scheduler")
    return LocalExecutor(roots.everywhere, save_every_s, jobs)
