"""Start the process of a run, wait for it, and start it again if it was killed."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from sigmasplat.plugins.batch.job import Job

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
