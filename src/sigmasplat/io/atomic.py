"""Write files completely or not at all: neither Ctrl-C nor a full disk leaves a partial file under its final name."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sigmasplat.errors import RunError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` if the block succeeds, else remove it.

    Raises RunError if the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as problem:
        temporary.unlink(missing_ok=True) if temporary.parent.is_dir() else None
        raise RunError(f"cannot write {path}: {problem.strerror or problem}; choose a writable place") from problem
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises RunError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def make_folder(path: Path) -> None:
    """Create a folder and its parents unless they exist. Raises RunError if that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise RunError(f"cannot write {path}: {problem.strerror or problem}; choose a writable place") from problem
