"""Lock what a command writes, a run folder or another output, so that two processes never write the same."""

import fcntl
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sigmasplat.errors import RunError
from sigmasplat.files.atomic import cannot_write, make_folder

LOCK = ".lock"
"""The locked file in a run folder; it contains the process and the computer. After a kill it stays, without a lock."""


@dataclass
class _Held:
    """A lock of this process, and how many blocks hold it; file None: the file system has no locks."""

    file: int | None
    blocks: int = 0


_held: dict[Path, _Held] = {}
_guard = threading.Lock()


def no_warning(line: str) -> None:
    """Ignore a warning."""


def locked(folder: Path, warn: Callable[[str], None] = no_warning, wait: bool = False) -> AbstractContextManager[None]:
    """Hold the lock of a run folder, which is created if it does not exist. Blocks of one process share the lock.

    The operating system removes the lock when the process ends, even if it is killed. wait: until another process ends
    its lock. Calls `warn` if the file system has no locks. Raises RunError, with the process that holds the lock, or if
    the folder cannot be written.
    """
    return _locked(folder / LOCK, f"run {folder}", warn, wait, make_folder)


def output_locked(target: Path, warn: Callable[[str], None] = no_warning) -> AbstractContextManager[None]:
    """Hold the lock of a file or folder to write, which need not exist; the lock is a hidden file beside it.

    Raises RunError as `locked`.
    """
    return _locked(target.with_name(f".{target.name}{LOCK}"), f"output {target}", warn, False, lambda folder: None)


@contextmanager
def _locked(
    path: Path, what: str, warn: Callable[[str], None], wait: bool, prepare: Callable[[Path], None]
) -> Iterator[None]:
    """Hold the lock of a file; prepare: called with its folder."""
    key = path.parent.resolve() / path.name
    with _guard:
        held = _held.get(key)
        if held is None:
            held = _held[key] = _Held(_acquired(path, what, warn, wait, prepare))
        held.blocks += 1
    try:
        yield
    finally:
        with _guard:
            held.blocks -= 1
            if not held.blocks:
                del _held[key]
                if held.file is not None:
                    with suppress(OSError):
                        key.unlink() if _is(key, held.file) else None
                    os.close(held.file)


def _acquired(
    path: Path, what: str, warn: Callable[[str], None], wait: bool, prepare: Callable[[Path], None]
) -> int | None:
    """Lock a file and write this process into it; return it, or None if the file system has no locks."""
    while True:
        prepare(path.parent)
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as problem:
            raise cannot_write(path.parent, problem) from problem
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as problem:
            holder = os.pread(file, 200, 0).decode(errors="replace")
            os.close(file)
            raise RunError(f"{what} is in use by {_described(holder)}") from problem
        except OSError as problem:
            os.close(file)
            warn(
                f"the file system of {path.parent} has no locks ({problem.strerror}); start no second command on {what}"
            )
            return None
        if _is(path, file):
            with suppress(OSError):  # a full disk: the lock holds without the number of the process
                os.ftruncate(file, 0)
                os.pwrite(file, f"{os.getpid()} {socket.gethostname()}\n".encode(), 0)
            return file
        os.close(file)  # another process removed the file at the end of its lock, just before this lock


def _is(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file))
    except OSError:
        return False


def _described(holder: str) -> str:
    number, _, host = holder.strip().partition(" ")
    if not number.isdecimal():
        return "another process; wait until it ends"
    if host and host != socket.gethostname():
        return f"process {number} on {host}; wait until it ends"
    return f"process {number}; wait until it ends, or stop it (kill {number})"
