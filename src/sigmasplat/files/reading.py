"""Read files that users give: only regular files, sizes before content, and every problem is an error of this package:
one line with place and remedy."""

import codecs
import csv
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from sigmasplat.errors import SigmaSplatError, SourceError

DAMAGED: tuple[type[Exception], ...] = (
    OSError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, AssertionError, SyntaxError, EOFError,
    MemoryError, RuntimeError, StopIteration, tokenize.TokenError, csv.Error, struct.error, zlib.error,
    zipfile.BadZipFile, zipfile.LargeZipFile,
)  # fmt: skip
"""What parsers raise on damaged or hostile content: the standard library, numpy, Pillow, safetensors and others.
RuntimeError includes RecursionError and NotImplementedError, ValueError includes UnicodeDecodeError."""

MOST_CHARACTERS = 160


@contextmanager
def guarded(where: object, remedy: str, error: type[SigmaSplatError], what: str = "unreadable") -> Iterator[None]:
    """Raise `error` as "WHERE: WHAT (cause); REMEDY" for every exception of `DAMAGED` in the block.

    Errors of this package pass unchanged: they already name place and remedy.
    """
    try:
        yield
    except DAMAGED as problem:
        name = problem.filename if isinstance(problem, OSError) else None
        file = "" if name is None or str(name) in str(where) else f": {str(name)[-MOST_CHARACTERS:]}"
        raise error(f"{where}: {what} ({cause(problem)}{file}); {remedy}") from problem


def cause(problem: BaseException) -> str:
    """Describe an exception in one short line."""
    if isinstance(problem, MemoryError):
        return "it needs more memory than there is"
    if isinstance(problem, RecursionError):
        return "it is nested too deep"
    text = (isinstance(problem, OSError) and problem.strerror) or " ".join(str(problem).split())
    text = "".join(c if c.isprintable() else "?" for c in text or type(problem).__name__)
    if isinstance(problem, LookupError):
        text = f"{text} is missing" if isinstance(problem, KeyError) else text
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} …"


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


@contextmanager
def open_binary(path: Path, error: str) -> Iterator[BinaryIO]:
    """Open a regular file for reading. If opening or reading fails, or the block cannot use its content, raises
    SourceError; `error` begins the message about a file that cannot be opened."""
    with open_regular(path, SourceError, failed=error) as file, guarded(path, "copy or download it again", SourceError):
        yield file


MOST_JSON_BYTES = 32 << 20
"""Largest JSON file of a recording, about 60 000 frames of nerfstudio: parsed JSON needs up to 30 times its size."""
MOST_OWN_JSON_BYTES = 512 << 20
"""Largest JSON file of a run, whose size grows with the run."""


def parse_json(text: str | bytes, where: object, error: type[SigmaSplatError] = SourceError) -> Any:
    """Parse JSON. Raises `error` naming `where` if it is not JSON, is nested too deep, or has endless numbers."""
    import json  # here, because every command imports this module

    try:
        return json.loads(text, parse_int=_whole_number)
    except (ValueError, RecursionError) as problem:  # ValueError: not UTF-8, too
        raise error(f"{where}: not readable as JSON ({cause(problem)}); correct it") from problem


def _whole_number(digits: str) -> int:
    if len(digits) > 308:  # no float is as large
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def read_json(path: Path, error: type[SigmaSplatError] = SourceError, most: int = MOST_JSON_BYTES) -> Any:
    """Read a JSON file. Raises `error` as `read_text` and `parse_json` do."""
    return parse_json(read_text(path, error, most), path, error)


def csv_rows(path: Path, errors: str = "strict") -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words without spaces around them) of every CSV line that is not empty.

    Raises SourceError as `read_text` does, or naming the line if it is not CSV or has a field above 131 kB.
    """
    lines = csv.reader(read_text(path, errors=errors).split("\n"))
    try:
        for words in lines:
            if words:
                yield lines.line_num, [word.strip() for word in words]
    except csv.Error as problem:
        raise SourceError(f"{path}:{lines.line_num}: not readable as CSV ({problem}); copy it again") from problem
