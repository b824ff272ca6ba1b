"""Make the missing runs of a batch: find their sequences, keep finished runs, and go on after a failure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import RunError
from sigmasplat.plugins.batch.executor import Executor
from sigmasplat.plugins.batch.job import Job, has_other_run

if TYPE_CHECKING:
    from sigmasplat.api import Screen


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
