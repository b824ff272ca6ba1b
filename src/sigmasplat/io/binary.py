"""Open binary files with the errors of this package."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sigmasplat.errors import SourceError


@contextmanager
def open_binary(path: Path, error: str) -> Iterator[BinaryIO]:
    """Open a file for reading. Raises SourceError, with a message that starts with `error`, if opening or reading fails."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as problem:
        raise SourceError(f"{error} {path}: {problem.strerror or problem}") from problem
