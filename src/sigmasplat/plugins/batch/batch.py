"""Make the missing runs of a batch: find their sequences, keep finished runs, and go on after a failure."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import ConfigError, Progress, RunError, RunFolder
from sigmasplat.plugins.batch.executor import DataRoots, Executor, LocalExecutor, Outcome, Sequences
from sigmasplat.plugins.batch.job import FACT, Job, has_other_run

if TYPE_CHECKING:
    from sigmasplat.api import Screen

LOOK_EVERY_S = 2.0


class Estimate:
    """Estimates the time left from the seconds per frame of finished runs, separately for each preset.

    frames: number of frames of each job, by its name; slots: number of runs at the same time.
    """

    def __init__(self, frames: Mapping[str, int], slots: int) -> None:
        self.frames, self.slots = frames, slots
        self.seconds = dict[str, float]()
        self.counted = dict[str, int]()

    def add(self, job: Job, seconds: float) -> None:
        """Add a finished run."""
        preset = job.config.name
        self.seconds[preset] = self.seconds.get(preset, 0.0) + seconds
        self.counted[preset] = self.counted.get(preset, 0) + self.frames[job.name]

    def left_s(self, jobs: Sequence[Job]) -> float | None:
        """Return the seconds that these jobs still take, None before the first run has finished.

        Presets without a finished run count with the mean of the others.
        """
        if not any(self.counted.values()):
            return None
        mean = sum(self.seconds.values()) / sum(self.counted.values())
        rates = {preset: self.seconds[preset] / frames for preset, frames in self.counted.items() if frames}
        return sum(rates.get(job.config.name, mean) * self.frames[job.name] for job in jobs) / self.slots


def duration(seconds: float) -> str:
    """Write a duration with its largest unit, and the next smaller one below ten: 45 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{round(seconds)} s"
    if minutes < 100:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"


@contextmanager
def frames_counted(jobs: Sequence[Job], frames: Mapping[str, int], out: Path, show: Progress) -> Iterator[None]:
    """Call `show(done, total)` with the frames of all runs from time to time, as read from their logs."""
    total, ended = sum(frames[job.name] for job in jobs), threading.Event()

    def look() -> None:
        while not ended.wait(LOOK_EVERY_S):
            show(sum(_logged(out / job.name) for job in jobs), total)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _logged(folder: Path) -> int:
    with suppress(OSError):
        return (folder / "log.jsonl").read_bytes().count(b"\n")
    return 0


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
                f"{self.out} contains {_counted(len(others))} of other settings, other code or other scores "
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
        rest = f", {_counted(len(waiting))} left, about {duration(left_s)}" if waiting and left_s is not None else ""
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


def _counted(runs: int) -> str:
    return "1 run" if runs == 1 else f"{runs} runs"
