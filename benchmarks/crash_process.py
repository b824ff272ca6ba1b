"""Run a command in a process of its own that kills itself at one of its file operations, and record these operations.

Operations are what Python's audit events report: a file opened to write, a rename, a removal, a new folder; and each
fsync. Files that a compiled library writes are seen when Python renames them.
"""

import importlib
import json
import os
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("SIGMASPLAT_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: threads do not survive a fork
LOADED = ("cli", "system.slam", "run.session", "run.terminal", "run.resume", "plugins.sources.synthetic")
"""Modules that are imported once, before the processes are forked."""
AUDITED = {"open": "create", "os.rename": "rename", "os.remove": "remove", "os.mkdir": "mkdir", "os.rmdir": "rmdir"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


@dataclass(frozen=True)
class Kill:
    """Kill the process before its operation number `at` (from 1), or `delay_s` after it began."""

    at: int
    delay_s: float = 0.0


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code (−9 if it was killed), what it printed, and its operations in order."""

    code: int
    output: str
    operations: list[dict[str, Any]]


class Recorder:
    """Writes each operation in a folder to a file, keeps a link to what it replaces or removes, and kills the process.

    fsync is recorded only: a process that is killed loses nothing that it has written.
    """

    def __init__(self, watched: Path, records: Path, kill: Kill | None) -> None:
        self.watched, self.kept, self.kill = f"{watched}/", records.with_name("kept"), kill
        self.kept.mkdir(exist_ok=True)
        self.file = os.open(records, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self.count = 0
        self.guard = threading.RLock()

    def start(self) -> None:
        """Record from now on, until the process ends."""
        sys.addaudithook(self.audited)
        os.fsync = self.synced

    def audited(self, event: str, arguments: tuple[Any, ...]) -> None:
        kind = AUDITED.get(event)
        if kind is None or isinstance(arguments[0], int):
            return
        if kind == "create" and not (arguments[2] or 0) & WRITING:
            return
        paths = [os.path.abspath(os.fsdecode(a)) for a in arguments[: 2 if kind == "rename" else 1]]
        if not paths[0].startswith(self.watched):
            return
        if kind in ("create", "mkdir") and os.path.exists(paths[0]):
            kind = "write"
        self.add(kind, path=paths[-1], source=paths[0], kept=paths[-1] if kind in ("rename", "remove") else None)

    def synced(self, file: int) -> None:
        status, path = os.fstat(file), os.readlink(f"/proc/self/fd/{file}")
        self.add("sync", path=path, inode=status.st_ino, size=status.st_size)

    def add(self, kind: str, kept: str | None = None, **facts: Any) -> None:
        with self.guard:
            self.count += 1
            if self.kill and self.count >= self.kill.at:
                self.die(self.kill.delay_s)
            if kept and os.path.lexists(kept):
                facts["kept"] = str(self.kept / f"{os.getpid()}-{self.count}")
                os.link(kept, facts["kept"])
            os.write(self.file, (json.dumps({"kind": kind, **facts}) + "\n").encode())

    def die(self, delay_s: float) -> None:
        if not delay_s:
            os.kill(os.getpid(), signal.SIGKILL)
        self.kill = None
        threading.Timer(delay_s, os.kill, (os.getpid(), signal.SIGKILL)).start()


def run(arguments: Sequence[str], watched: Path, scratch: Path, kill: Kill | None = None) -> Ended:
    """Run `sigmasplat` with these arguments in a fork of this process, which must not have used torch's threads.

    The state is saved after every frame.
    """
    for name in LOADED:
        importlib.import_module(f"sigmasplat.{name}")
    records, output = scratch / "operations.jsonl", scratch / "output.txt"
    child = os.fork()
    if not child:
        code = 1
        try:
            code = _command(arguments, Recorder(watched, records, kill), output)
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    *lines, _ = records.read_text(encoding="utf-8").split("\n")  # a half line: its operation never began
    operations = [json.loads(line) for line in lines]
    return Ended(os.waitstatus_to_exitcode(status), output.read_text(encoding="utf-8"), operations)


def _command(arguments: Sequence[str], recorder: Recorder, output: Path) -> int:
    from sigmasplat import cli
    from sigmasplat.run import resume

    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    os.dup2(file, 1)
    os.dup2(file, 2)
    resume.MOST_TIME_SHARE = float("inf")
    recorder.start()
    try:
        cli.main(arguments)
    except SystemExit as end:
        sys.stdout.flush()
        sys.stderr.flush()
        return int(end.code or 0)
    return 1
