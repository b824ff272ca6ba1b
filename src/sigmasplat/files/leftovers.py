"""Find and remove the temporary files that a killed process left in a run folder."""

import re
from collections.abc import Iterator
from pathlib import Path

ENDINGS = ("json", "jsonl", "txt", "ply", "html", "png", "safetensors")
"""Endings of the files of a run."""
OURS = re.compile(rf"\..+\.({'|'.join(ENDINGS)})\.part")
"""Temporary names of `io.atomic`."""
OF_SAFETENSORS = re.compile(r"\.tmp[A-Za-z0-9]{6}")
"""Temporary names of the library safetensors, which writes under one and renames."""


def leftovers(*folders: Path) -> Iterator[Path]:
    """Yield the temporary files in these folders; call it only while no process writes there (`io.lock`)."""
    for folder in folders:
        for path in folder.iterdir() if folder.is_dir() else ():
            named = OURS.fullmatch(path.name) or OF_SAFETENSORS.fullmatch(path.name)
            if named and path.is_file() and not path.is_symlink():
                yield path


def remove_leftovers(*folders: Path) -> None:
    """Remove the temporary files in these folders; other files are kept."""
    for path in [*leftovers(*folders)]:
        path.unlink(missing_ok=True)
