"""Define the entries of the catalogue of public data sets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import urlsplit


@dataclass(frozen=True)
class RemoteFile:
    """A file on a server: an archive, recognised by its name, or a plain file.

    size_bytes: of the download, None if not published; checksum: "sha256:…" or "md5:…", or the start of one, or "" if
    unknown, and then the size is approximate; into: the folder it is unpacked to, below the recording's folder (for a
    plain file: its name); nested: whether it contains further archives.
    """

    url: str
    size_bytes: int | None = None
    checksum: str = ""
    into: str = ""
    nested: bool = False

    @property
    def name(self) -> str:
        """Return the file name on the server."""
        return PurePosixPath(urlsplit(self.url).path).name


@dataclass(frozen=True)
class PublicRecording:
    """One download: the contents of `archives` form `folder`; `start` is the first sequence below it."""

    folder: str
    archives: tuple[RemoteFile, ...]
    start: str = ""

    @property
    def size_bytes(self) -> int | None:
        """Return the total size of the downloads, None if one of them is unknown."""
        sizes = [archive.size_bytes for archive in self.archives]
        return None if None in sizes else sum(size or 0 for size in sizes)


@dataclass(frozen=True)
class PublicSet:
    """A data set that can be downloaded without registration.

    folder: below the data folder; recordings: by short name, "" if there is only one; max_bytes, max_files: limits on
    the size of an archive and the number of files in it; disk_ratio: bytes on disk during unpacking, per byte of the
    archive; prefix: optional prefix of the short names; sequences: whether the recordings are sequences, not weights.
    """

    title: str
    page: str
    licence: str
    folder: str
    recordings: Mapping[str, PublicRecording]
    max_bytes: int
    max_files: int
    disk_ratio: float = 1.3
    prefix: str = ""
    sequences: bool = True


@dataclass(frozen=True)
class RestrictedSet:
    """A data set available only on request; page: where to apply."""

    title: str
    page: str
