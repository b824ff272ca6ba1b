"""Make one run in this process: python -m sigmasplat.plugins.batch.make_run JOB FOLDER SECONDS [DATA].

SECONDS is the time between two saved states.

A stopped run is resumed from its last saved state; the result has the same bytes as an uninterrupted run. The process
ends when its standard input is closed, so it does not outlive the program that started it, even if that was killed.
"""

import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import torch

import sigmasplat.api as api
from sigmasplat.api import Config, RunFolder, SigmaSplatError, Source, StartPoint, env
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.evaluation.metrics.lpips import find_lpips

REFUSED, INTERRUPTED = 2, 130


def make_run(job: Job, folder: Path, data: str | None, save_every_s: float) -> None:
    """Make, resume or only score the run of a job, whichever is left to do.

    Raises SigmaSplatError if the sequence or the result cannot be used, KeyboardInterrupt if Ctrl-C stopped the run.
    """
    try:
        with api.locked(folder, wait=True):  # a second process waits
            if job.finished_in(folder):
                return
            path = job.sequence(data)
            source, config = api.open_scene(path, job.config, job.given)
            _make_and_score(job, RunFolder(folder), source, config, path, save_every_s)
    except BaseException:
        with suppress(OSError):  # the lock has created the folder
            folder.rmdir()
        raise


def _make_and_score(
    job: Job, run: RunFolder, source: Source, config: Config, path: str, save_every_s: float
) -> None:  # fmt: skip
    if not (job.started_in(run.path) and run.facts().get("status") == "complete"):
        run, start = _started(job, run.path, source, config, path)
        state = api.StateFile(start.slam, run, save_every_s)
        outcome = api.Session(start.slam, source, run, (), state, start.next_index, start.wall_s).execute()
        if outcome.status == "interrupted":
            raise KeyboardInterrupt
    started_s = time.perf_counter()
    lpips, _ = find_lpips(env.LPIPS_FOLDER)
    if why := evaluate(run, source, mesh=job.mesh, lpips=lpips)["failure"]:
        raise api.RunError(why)
    run.note(batch=job.facts() | {"scored": True, "scoring_s": time.perf_counter() - started_s})


def _started(job: Job, folder: Path, source: Source, config: Config, path: str) -> tuple[RunFolder, StartPoint]:
    """Resume the run in a folder if it is one of this job and has a state, else begin it."""
    if job.started_in(folder) and RunFolder(folder).state.is_file():
        with suppress(SigmaSplatError):  # a damaged state costs time, not the table
            run = RunFolder.open(folder)
            start = api.resume(run, source)
            run.note(status="running", source_path=path)
            return run, start
    run = api.new_folder(folder, config, source, overwrite=True, source_path=path, batch=job.facts())
    return run, StartPoint(api.Slam(config, run.submaps.in_background()))


def _end_with_parent() -> None:
    """Wait until standard input is closed, then end the process at once."""
    while os.read(0, 4096):
        pass
    os._exit(INTERRUPTED)


def main(job_text: str, folder: str, save_every_s: str, data: str | None = None) -> int:
    """Make the run of a job, and return the exit code; an error is one line on standard error."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        if env.switches().threads:
            torch.set_num_threads(env.switches().threads)
        make_run(Job.from_json(job_text), Path(folder), data, float(save_every_s))
    except SigmaSplatError as problem:
        print(problem, file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as problem:
        if not api.is_out_of_memory(problem):
            raise
        print(api.out_of_memory(problem), file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
