"""Say what a public data set is made of."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import urlsplit


@dataclass(frozen=True)
class RemoteFile:
    """A file on a server: an archive, or a plain file where its name ends otherwise.

    size_bytes: of the download, None where nobody says; checksum: "sha256:…" or "md5:…", "" where none is known, and
    then the size is rough; into: where it is unpacked, below the recording's folder (a plain file: its new name);
    nested: whether it holds archives in turn.
    """

    url: str
    size_bytes: int | None = None
    checksum: str = ""
    into: str = ""
    nested: bool = False

    @property
    def name(self) -> str:
        """Name the file as the server does."""
        return PurePosixPath(urlsplit(self.url).path).name


@dataclass(frozen=True)
class PublicRecording:
    """What is downloaded at once: `folder` is made of `archives`; `start`, below it, is a sequence to begin with."""

    folder: str
    archives: tuple[RemoteFile, ...]
    start: str = ""

    @property
    def size_bytes(self) -> int | None:
        """Add up the downloads; None where one of them is unknown."""
        sizes = [archive.size_bytes for archive in self.archives]
        return None if None in sizes else sum(size or 0 for size in sizes)


@dataclass(frozen=True)
class PublicSet:
    """A data set that may be downloaded without asking.

    folder: below the data folder; recordings: by short name, "" where there is one only; max_bytes: no archive is
    larger; max_files: none holds more; disk_ratio: bytes on disk while unpacking, for each byte of the archive;
    prefix: what may stand before a short name.
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


@dataclass(frozen=True)
class RestrictedSet:
    """A data set whose owners want to be asked: where."""

    title: str
    page: str
