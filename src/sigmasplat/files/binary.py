"""Open binary files with the errors of this package."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sigmasplat.errors import SourceError
from sigmasplat.files.guard import guarded
from sigmasplat.files.reading import open_regular


@contextmanager
def open_binary(path: Path, error: str) -> Iterator[BinaryIO]:
    """Open a regular file for reading. If opening or reading fails, or the block cannot use its content, raises
    SourceError; `error` begins the message about a file that cannot be opened."""
    with open_regular(path, SourceError, failed=error) as file, guarded(path, "copy or download it again", SourceError):
        yield file
