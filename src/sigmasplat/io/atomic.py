"""Write files whole or not at all, so that Ctrl-C or a full disk never leaves half a file under its real name."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sigmasplat.errors import RunError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; put it in place when the block succeeds, remove it otherwise.

    Raises RunError if the place cannot be written.
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
    """Write a UTF-8 text file in one step. Raises RunError if the place cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
