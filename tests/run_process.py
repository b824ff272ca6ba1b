"""Run `sigmasplat run` in a separate process, to interrupt or kill it."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOM = "synthetic:frames=200,width=80,height=60"
QUICK = ["input.width=80", "mapping.first_iterations=5", "mapping.iterations=3", "submaps.distance_m=0",
         "final.iterations=5"]  # fmt: skip
PATIENCE_S = 90.0


@contextmanager
def running(out: Path, *settings: str, room: str = ROOM, more: Sequence[str] = ()) -> Iterator[subprocess.Popen[str]]:
    """Start a run in a separate process, with additional settings and options; kill it at the end."""
    set_to = [word for setting in (*QUICK, *settings) for word in ("--set", setting)]
    command = [sys.executable, "-m", "sigmasplat.cli", "run", room, "--out", str(out), *set_to, *more]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ, preexec_fn=_hang_up_ends
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def _hang_up_ends() -> None:
    """Undo what nohup did to the tests: an ignored SIGHUP stays ignored in child processes."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def wait_for(process: subprocess.Popen[str], happened: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert process.poll() is None, f"ended too early: {process.communicate()}"
        assert time.monotonic() < deadline_s, "timeout"
        time.sleep(0.01)


def lines(out: Path) -> int:
    """Count the complete lines of the log."""
    log = out / "log.jsonl"
    return log.read_text().count("\n") if log.exists() else 0


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let no file grow beyond a size, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
