"""Store a partial download, and the version of the remote file it belongs to.

NAME.part        the bytes downloaded so far
NAME.part.json   {"url", "version", "size_bytes"} of the remote file
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path

from sigmasplat.errors import DownloadError


@dataclass(frozen=True)
class RemoteVersion:
    """A version of a remote file; version: its ETag or date, "" if the server sends neither."""

    url: str
    version: str
    size_bytes: int | None


class PartialFile:
    """The downloaded part of `target`, open for writing and locked against other processes."""

    def __init__(self, target: Path, file: FileIO) -> None:
        self.target, self._file = target, file
        self._note = _note_path(target)

    @property
    def size_bytes(self) -> int:
        """Return the number of bytes downloaded so far."""
        return self._file.tell()

    def version_of(self, url: str) -> RemoteVersion | None:
        """Return the version of the bytes so far; if it is unknown or not of `url`, delete them and return None."""
        try:
            version = RemoteVersion(**json.loads(self._note.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            version = None
        too_many = version and version.size_bytes is not None and self.size_bytes > version.size_bytes
        if version is None or version.url != url or too_many:
            self.restart()
            return None
        return version

    def restart(self) -> None:
        """Delete the bytes so far."""
        self._note.unlink(missing_ok=True)
        self._file.seek(0)
        self._file.truncate()

    def begin(self, version: RemoteVersion) -> None:
        """Record the version of the following bytes."""
        with _writing(self.target):
            self._note.write_text(json.dumps(asdict(version)), encoding="utf-8")

    def add(self, chunk: bytes) -> None:
        """Write a chunk. Raises DownloadError if the disk is full."""
        rest = memoryview(chunk)
        with _writing(self.target):
            while rest:
                rest = rest[_write_some(self._file, rest) :]

    def finish(self) -> None:
        """Rename the complete file to its final name."""
        with _writing(self.target):
            self._file.flush()
            os.fsync(self._file.fileno())
            os.replace(self._file.name, self.target)
        self._note.unlink(missing_ok=True)


@contextmanager
def open_partial(target: Path) -> Iterator[PartialFile]:
    """Open the existing part of `target`, or an empty one. Raises DownloadError if another process writes it."""
    with _writing(target):
        file = target.with_name(f"{target.name}.part").open("ab", buffering=0)
    with file:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as problem:
                raise DownloadError(f"{file.name} is being downloaded by another process; wait for it") from problem
        try:
            yield PartialFile(target, file)
        finally:
            if not file.tell():
                Path(file.name).unlink(missing_ok=True)
                _note_path(target).unlink(missing_ok=True)


def _write_some(file: FileIO, chunk: memoryview) -> int:
    """Write as much of a chunk as one call accepts; return the number of bytes."""
    return file.write(chunk)


def _note_path(target: Path) -> Path:
    return target.with_name(f"{target.name}.part.json")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert OSError to DownloadError."""
    try:
        yield
    except OSError as problem:
        raise DownloadError(
            f"cannot write {path}: {problem.strerror or problem}; the part downloaded so far is kept"
        ) from problem
