"""Read the files of a recording from a zip archive, or from the unpacked folder."""

import re
import zipfile
from pathlib import Path

from sigmasplat.errors import SourceError
from sigmasplat.files.guard import guarded
from sigmasplat.files.reading import read_bytes

MOST_MEMBER_BYTES = 128 << 20
"""Largest file of an archive after unzipping: an image, or its depth."""


class Archive:
    """The files of a zip archive or of its unpacked folder, by relative name; nothing is unpacked to disk."""

    def __init__(self, path: Path) -> None:
        """List the files. Raises SourceError if a file is not a complete zip archive."""
        self.path, self._zip = path, None
        if path.is_dir():
            self.names = [str(entry.relative_to(path)) for part in ("*", "*/*") for entry in path.glob(part)]
            return
        with guarded(path, "copy it again", SourceError, "not a complete zip archive"):
            self._zip = zipfile.ZipFile(path)
        self.names = self._zip.namelist()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def read(self, name: str, most: int = MOST_MEMBER_BYTES) -> bytes:
        """Return the bytes of a file. Raises SourceError naming it if it is missing, damaged, encrypted, or has more
        than `most` bytes."""
        where = self.path / name
        if self._zip is None:
            return read_bytes(where, SourceError, most)
        failed = "cannot be read from its archive"
        with guarded(where, "copy it again", SourceError, failed), self._zip.open(name) as member:
            data = member.read(most + 1)
        if len(data) > most:
            raise SourceError(f"{where}: unzips to more than {most / 1e6:.0f} MB; is it the right file?")
        return data

    def by_number(self, folder: str, endings: str) -> dict[int, str]:
        """Map N to each name folder/N.ending, in order of N; `endings` is a regular expression such as "jpg|png"."""
        found = [(re.fullmatch(rf"{folder}/(\d+)\.({endings})", name), name) for name in self.names]
        return dict(sorted((int(match.group(1)), name) for match, name in found if match))
