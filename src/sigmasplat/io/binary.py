"""Open binary files with the errors of this package."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sigmasplat.errors import SourceError


@contextmanager
def open_binary(path: Path, error: str) -> Iterator[BinaryIO]:
    """Open a file for reading. If opening or reading fails, raises SourceError with `error` as start of its message."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as problem:
        raise SourceError(f"{error} {path}: {problem.strerror or problem}") from problem
