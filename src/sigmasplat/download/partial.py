"""Keep what has come of a file so far, and know which version of the file it is a part of.

NAME.part        the bytes so far
NAME.part.json   {"url", "version", "size_bytes"}: where they came from
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
    """Where a file comes from; version: its ETag or date, "" if the server names neither."""

    url: str
    version: str
    size_bytes: int | None


class PartialFile:
    """The part of `target` that is on disk: open for writing, and nobody else's while it is."""

    def __init__(self, target: Path, file: FileIO) -> None:
        self.target, self._file = target, file
        self._note = _note_path(target)

    @property
    def size_bytes(self) -> int:
        """Count the bytes so far."""
        return self._file.tell()

    def origin(self, url: str) -> RemoteVersion | None:
        """Return where the bytes so far came from; None, and no bytes, where that was not `url` or is not known."""
        try:
            origin = RemoteVersion(**json.loads(self._note.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            origin = None
        too_many = origin and origin.size_bytes is not None and self.size_bytes > origin.size_bytes
        if origin is None or origin.url != url or too_many:
            self.restart()
            return None
        return origin

    def restart(self) -> None:
        """Forget what has come so far."""
        self._note.unlink(missing_ok=True)
        self._file.seek(0)
        self._file.truncate()

    def begin(self, origin: RemoteVersion) -> None:
        """Note where the bytes to come are from."""
        with _writing(self.target):
            self._note.write_text(json.dumps(asdict(origin)), encoding="utf-8")

    def add(self, chunk: bytes) -> None:
        """Write a chunk. Raises DownloadError if the disk is full."""
        rest = memoryview(chunk)
        with _writing(self.target):
            while rest:
                rest = rest[_write_some(self._file, rest) :]

    def finish(self) -> None:
        """Put the file in place under its own name: it is whole."""
        with _writing(self.target):
            self._file.flush()
            os.fsync(self._file.fileno())
            os.replace(self._file.name, self.target)
        self._note.unlink(missing_ok=True)


@contextmanager
def open_partial(target: Path) -> Iterator[PartialFile]:
    """Open the part of `target` that is there, or an empty one. Raises DownloadError if another process writes it."""
    with _writing(target):
        file = target.with_name(f"{target.name}.part").open("ab", buffering=0)
    with file:
        with suppress(OSError):  # a file system without locks: then nobody is kept out
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
    """Write as much of a chunk as fits into one call; return how much."""
    return file.write(chunk)


def _note_path(target: Path) -> Path:
    return target.with_name(f"{target.name}.part.json")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn what may go wrong in writing into one line."""
    try:
        yield
    except OSError as problem:
        raise DownloadError(f"cannot write {path}: {problem.strerror or problem}; what has come is kept") from problem
