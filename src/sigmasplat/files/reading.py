"""Read whole files within a budget: only regular files, whose size is checked before they are read."""

import codecs
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.files.guard import cause

MOST_TEXT_BYTES = 128 << 20
"""Largest text file: a list of images at 30 Hz has about 1 MB per ten minutes, measurements of a gyroscope ten times
as much."""
KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFDIR: "a folder",
         stat.S_IFSOCK: "a socket"}  # fmt: skip


@contextmanager
def open_regular(
    path: Path, error: type[SigmaSplatError] = SourceError, most: int | None = None, failed: str = "cannot read"
) -> Iterator[BinaryIO]:
    """Open a regular file for reading. Raises `error` if it cannot be opened or read, is a pipe, device or folder, or
    has more than `most` bytes; `failed` begins its message."""
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                kind = KINDS.get(stat.S_IFMT(found.st_mode), "not a regular file")
                raise error(f"{failed} {path}: it is {kind}; give a regular file")
            if most is not None and found.st_size > most:
                size = f"{found.st_size / 1e6:.0f} MB, the limit is {most / 1e6:.0f} MB"
                raise error(f"{failed} {path}: it has {size}; is it the right file?")
            yield file
    except (OSError, ValueError) as problem:  # ValueError: a name with a NUL character
        raise error(f"{failed} {path}: {cause(problem)}; check that it exists and may be read") from problem


def refuse_special(path: Path, error: type[SigmaSplatError] = SourceError, most: int | None = None) -> None:
    """Raise `error` as `open_regular` does; call it before a library opens a file, which would wait at a pipe."""
    with open_regular(path, error, most):
        pass


def exists(path: Path) -> bool:
    """Return whether there is an entry of this name, also if it is a broken link, which reading then refuses."""
    return os.path.lexists(path)


def read_bytes(path: Path, error: type[SigmaSplatError] = SourceError, most: int = MOST_TEXT_BYTES) -> bytes:
    """Return the content of a regular file. Raises `error` as `open_regular` does."""
    with open_regular(path, error, most) as file:
        return file.read(most + 1)[:most]


def read_text(
    path: Path, error: type[SigmaSplatError] = SourceError, most: int = MOST_TEXT_BYTES, errors: str = "strict"
) -> str:
    """Return UTF-8 text with "\\n" line ends, without byte order mark; `errors` as in `bytes.decode`.

    Raises `error` if the file cannot be read, is too large, or is not UTF-8.
    """
    data = read_bytes(path, error, most)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) and errors == "strict":
        raise error(f"cannot read {path}: it is UTF-16; save it as UTF-8")
    try:
        text = data.removeprefix(codecs.BOM_UTF8).decode("utf-8", errors)
    except UnicodeDecodeError as problem:
        line = data.count(b"\n", 0, problem.start) + 1
        raise error(f"cannot read {path}:{line}: it is not text ({cause(problem)}); save it as UTF-8") from problem
    return text.replace("\r\n", "\n").replace("\r", "\n")
