"""Read the files of a recording from a zip archive, or from the unpacked folder."""

import re
import zipfile
import zlib
from pathlib import Path

from sigmasplat.errors import SourceError


class Archive:
    """The files of a zip archive or of its unpacked folder, by relative name; nothing is unpacked to disk."""

    def __init__(self, path: Path) -> None:
        """List the files. Raises SourceError if a file is not a complete zip archive."""
        self.path, self._zip = path, None
        if path.is_dir():
            self.names = [str(entry.relative_to(path)) for part in ("*", "*/*") for entry in path.glob(part)]
            return
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise SourceError(f"{path}: not a complete zip archive ({error}); copy it again") from error
        self.names = self._zip.namelist()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def read(self, name: str) -> bytes:
        """Return the bytes of a file. Raises SourceError naming it if it is missing or damaged."""
        try:
            return (self.path / name).read_bytes() if self._zip is None else self._zip.read(name)
        except (OSError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
            raise SourceError(
                f"{self.path / name}: cannot be read from its archive ({error}); copy it again"
            ) from error

    def by_number(self, folder: str, endings: str) -> dict[int, str]:
        """Map N to each name folder/N.ending, in order of N; `endings` is a regular expression such as "jpg|png"."""
        found = [(re.fullmatch(rf"{folder}/(\d+)\.({endings})", name), name) for name in self.names]
        return dict(sorted((int(match.group(1)), name) for match, name in found if match))
