"""Write files completely or not at all: Ctrl-C, a full disk or a power failure leave no partial file under its final
name. What a killed process left is found and removed."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sigmasplat.errors import RunError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; if the block succeeds, rename it to `path`, else remove it.

    The content is on the disk before the rename, and the rename is on the disk when the block ends. Raises RunError if
    the file cannot be written.
    """
    temporary = part_of(path)
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as problem:
        temporary.unlink(missing_ok=True) if temporary.parent.is_dir() else None
        raise cannot_write(path, problem) from problem
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def part_of(path: Path) -> Path:
    """Return the temporary path from which `path` is renamed."""
    return path.with_name(f".{path.name}.part")


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk. Raises RunError if it cannot be written."""
    try:
        _sync(path)
    except OSError as problem:
        raise cannot_write(path, problem) from problem


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk; some file systems cannot do this, and nothing happens there."""
    with suppress(OSError):
        _sync(folder)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises RunError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def cannot_write(path: Path, problem: OSError) -> RunError:
    """Return the error of a file that cannot be written."""
    return RunError(f"cannot write {path}: {problem.strerror or problem}; choose a writable place")


def make_folder(path: Path) -> None:
    """Create a folder and its parents unless they exist; their names are then on the disk.

    Raises RunError if that is not possible.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise cannot_write(path, problem) from problem
    for folder in missing:
        sync_folder(folder.parent)


ENDINGS = ("json", "jsonl", "txt", "ply", "html", "png", "safetensors")
"""Endings of the files of a run."""
OURS = re.compile(rf"\..+\.({'|'.join(ENDINGS)})\.part")
"""Temporary names of `part_of`."""
OF_SAFETENSORS = re.compile(r"\.tmp[A-Za-z0-9]{6}")
"""Temporary names of the library safetensors, which writes under one and renames."""


def remove_leftovers(*folders: Path) -> None:
    """Remove the temporary files in these folders; call it only while no process writes there (`files.lock`)."""
    for folder in folders:
        for path in [*folder.iterdir()] if folder.is_dir() else ():
            named = OURS.fullmatch(path.name) or OF_SAFETENSORS.fullmatch(path.name)
            if named and path.is_file() and not path.is_symlink():
                path.unlink(missing_ok=True)
