"""Unpack an untrusted archive below one folder, by the standard library; links and too much content are refused."""

import gzip
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import DownloadError

if TYPE_CHECKING:
    from sigmasplat.api import Progress

CHUNK_BYTES = 2**20
DAMAGE = (
    tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, FileExistsError, NotADirectoryError, IsADirectoryError,
)  # fmt: skip
DESKTOP_FILES = {"__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"}


class ArchiveError(DownloadError):
    """The archive is damaged or unsafe."""


def is_archive(name: str) -> bool:
    """Return whether a file is an archive, by its name."""
    return name.lower().endswith((".zip", ".tgz", ".tar.gz"))


def unpack(archive: Path, folder: Path, most_bytes: int, progress: "Progress") -> None:
    """Unpack a .tar.gz or .zip to `folder`, which is created; progress(done, total) counts the archive's bytes.

    Raises ArchiveError if the archive is damaged, holds links or names outside the folder, or more than `most_bytes`;
    DownloadError if the disk is full. Files written before the error remain, so use a temporary folder.
    """
    with _naming_archive(archive):
        folder.mkdir(parents=True, exist_ok=True)
        if archive.name.lower().endswith(".zip"):
            _unpack_zip(archive, folder, most_bytes, progress)
        else:
            _unpack_tar(archive, folder, most_bytes, progress)
    progress(archive.stat().st_size, archive.stat().st_size)


@contextmanager
def _naming_archive(archive: Path) -> Iterator[None]:
    try:
        yield
    except ArchiveError as problem:
        raise ArchiveError(f"{archive.name} {problem}; it is refused, and no file of it is kept") from problem
    except tarfile.FilterError as problem:
        raise ArchiveError(f"{archive.name} is unsafe ({problem}); no file of it is kept") from problem
    except (*DAMAGE, zlib.error, EOFError, NotImplementedError, RuntimeError) as problem:
        raise ArchiveError(f"{archive.name} is damaged ({problem}); no file of it is kept") from problem
    except OSError as problem:
        raise DownloadError(f"cannot unpack {archive}: {problem.strerror or problem}; is the disk full?") from problem


def _unpack_tar(archive: Path, folder: Path, most_bytes: int, progress: "Progress") -> None:
    size_bytes = archive.stat().st_size
    with archive.open("rb") as packed, tarfile.open(fileobj=packed, mode="r:gz") as tar:
        for member in tar:
            most_bytes = _less(most_bytes, member.size)
            if not (member.isreg() or member.isdir()):
                raise ArchiveError(f"holds {member.name!r}, which is not a plain file or folder")
            if not _is_litter(member.name):
                tar.extract(member, folder, filter="data")
            progress(min(packed.tell(), size_bytes - 1), size_bytes)
        while tar.fileobj.read(CHUNK_BYTES):  # type: ignore[union-attr]  # to the end, where the checksum is
            pass


def _unpack_zip(archive: Path, folder: Path, most_bytes: int, progress: "Progress") -> None:
    with zipfile.ZipFile(archive) as zipped:
        done, entries = 0, zipped.infolist()
        for entry in entries:  # check the headers before anything is written
            most_bytes = _less(most_bytes, entry.file_size)
            if stat.S_ISLNK(entry.external_attr >> 16):
                raise ArchiveError(f"holds {entry.filename!r}, which is not a plain file or folder")
        for entry in entries:
            entry.filename = entry.filename.replace("\\", "/")  # as some programs of Windows write it
            if not _is_litter(entry.filename):
                zipped.extract(entry, folder)
            done += entry.compress_size
            progress(done, archive.stat().st_size)


def _less(most_bytes: int, size_bytes: int) -> int:
    if size_bytes > most_bytes:
        raise ArchiveError("holds more bytes than expected for this data set")
    return most_bytes - size_bytes


def _is_litter(name: str) -> bool:
    parts = name.split("/")
    return bool(DESKTOP_FILES.intersection(parts)) or parts[-1].startswith("._")
