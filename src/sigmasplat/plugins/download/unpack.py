"""Unpack an untrusted archive: only files and folders below one folder, within a budget.

Links, devices, absolute names, names that leave the folder, and archives that expand too much are refused.
"""

import gzip
import io
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from sigmasplat.api import DownloadError

if TYPE_CHECKING:
    from sigmasplat.api import Progress

CHUNK_BYTES = 2**20
MAX_RATIO, RATIO_CHECKED_ABOVE_BYTES = 200, 2**20
"""Maximum compression ratio of a file above 1 MiB in a zip; images hardly compress, text to a fifth."""
DESKTOP_FILES = {"__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"}


class ArchiveError(DownloadError):
    """The archive is damaged or unsafe."""


@dataclass
class Budget:
    """Bytes and files that may still be written."""

    bytes: int
    files: int

    def spend(self, bytes: int, files: int) -> None:
        """Subtract bytes, and files or folders, to be written. Raises ArchiveError if the budget is exceeded."""
        self.bytes, self.files = self.bytes - bytes, self.files - files
        if self.bytes < 0 or self.files < 0:
            what = "bytes" if self.bytes < 0 else "files"
            raise ArchiveError(f"holds more {what} than expected for this data set")


def is_archive(name: str) -> bool:
    """Return whether a file is an archive, by its name."""
    return name.lower().endswith((".zip", ".tgz", ".tar.gz"))


def unpack(archive: Path, folder: Path, budget: Budget, progress: "Progress") -> None:
    """Unpack a .tar.gz or .zip to `folder`, which is created; progress(done, total) counts the archive's bytes.

    Raises ArchiveError if the archive is damaged, unsafe or exceeds the budget, DownloadError if the disk is full.
    Files written before the error remain, so use a temporary folder.
    """
    with _naming_archive(archive):
        folder.mkdir(parents=True, exist_ok=True)
        if archive.name.lower().endswith(".zip"):
            _unpack_zip(archive, folder, budget, progress)
        else:
            _unpack_tar(archive, folder, budget, progress)


@contextmanager
def _naming_archive(archive: Path) -> Iterator[None]:
    try:
        yield
    except ArchiveError as problem:
        raise ArchiveError(f"{archive.name} {problem}; it is refused, and no file of it is kept") from problem
    except (tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, zlib.error, EOFError) as problem:
        raise ArchiveError(f"{archive.name} is damaged ({problem}); no file of it is kept") from problem
    except (NotImplementedError, RuntimeError) as problem:  # unsupported compression, or encrypted
        raise ArchiveError(f"{archive.name} cannot be read ({problem}); no file of it is kept") from problem
    except OSError as problem:
        raise DownloadError(f"cannot unpack {archive}: {problem.strerror or problem}; is the disk full?") from problem


def _unpack_tar(archive: Path, folder: Path, budget: Budget, progress: "Progress") -> None:
    size_bytes = archive.stat().st_size
    with archive.open("rb") as packed, gzip.GzipFile(fileobj=packed) as inflated:
        stream = _BudgetedStream(inflated, budget)
        with tarfile.open(fileobj=stream, mode="r|") as tar:
            for member in tar:
                budget.spend(0, 1)
                place = _target_path(folder, member.name)
                if member.isdir():
                    _make_folder(place)
                elif member.isreg() and not member.issparse():
                    source = tar.extractfile(member)
                    assert source is not None
                    _copy(source, place, member.size)
                else:
                    raise ArchiveError(f"holds {member.name!r}, which is not a plain file or folder")
                progress(min(packed.tell(), size_bytes - 1), size_bytes)
        while stream.read(CHUNK_BYTES):  # read to the end, where the checksum of the stream is
            pass
    progress(size_bytes, size_bytes)


class _BudgetedStream(io.RawIOBase):
    """Read a stream and subtract its bytes from a budget."""

    def __init__(self, stream: gzip.GzipFile, budget: Budget) -> None:
        self._stream, self._budget = stream, budget

    def read(self, size: int = -1) -> bytes:
        """Read at most `size` bytes."""
        chunk = self._stream.read(size)
        self._budget.spend(len(chunk), 0)
        return chunk


def _unpack_zip(archive: Path, folder: Path, budget: Budget, progress: "Progress") -> None:
    with zipfile.ZipFile(archive) as zipped:
        entries = zipped.infolist()
        for entry in entries:  # check the headers before anything is written
            budget.spend(entry.file_size, 1)
            _check_entry(entry)
            _target_path(folder, entry.filename)
        done, total = 0, sum(entry.compress_size for entry in entries)
        for entry in entries:
            place = _target_path(folder, entry.filename)
            if entry.is_dir():
                _make_folder(place)
            else:
                with zipped.open(entry) as source:
                    _copy(source, place, entry.file_size)
            progress(done, total)
            done += entry.compress_size
        progress(total, total)


def _check_entry(entry: zipfile.ZipInfo) -> None:
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in {0, stat.S_IFREG, stat.S_IFDIR}:
        raise ArchiveError(f"holds {entry.filename!r}, which is not a plain file or folder")
    if entry.file_size > RATIO_CHECKED_ABOVE_BYTES and entry.file_size > MAX_RATIO * entry.compress_size:
        raise ArchiveError(
            f"holds {entry.filename!r}, which expands {entry.file_size // max(entry.compress_size, 1)}-fold"
        )


def _target_path(folder: Path, name: str) -> Path | None:
    """Return the path for an entry, None for a desktop's own files. Raises ArchiveError if it is not below `folder`.

    Windows separators are supported.
    """
    parts = name.replace("\\", "/").split("/")
    if name.startswith(("/", "\\")) or ".." in parts or "\0" in name or parts[0].endswith(":"):
        raise ArchiveError(f"holds {name!r}, a name that leaves the folder")
    kept = [part for part in parts if part not in {"", "."}]
    if not kept:
        return folder
    litter = DESKTOP_FILES & set(kept) or kept[-1].startswith("._")
    return None if litter else folder.joinpath(*kept)


def _make_folder(place: Path | None) -> None:
    if place is not None:
        with _refusing_duplicates(place):
            place.mkdir(parents=True, exist_ok=True)


def _copy(source: IO[bytes], place: Path | None, size_bytes: int) -> None:
    """Copy a file. Raises ArchiveError if its size differs from `size_bytes`, or the path already exists."""
    if place is None:
        return
    with _refusing_duplicates(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with place.open("xb") as file:
            left = size_bytes
            while chunk := source.read(CHUNK_BYTES):
                left -= len(chunk)
                file.write(chunk)
    if left:
        raise ArchiveError(f"is damaged: {place.name} does not have the size in its header")


@contextmanager
def _refusing_duplicates(place: Path) -> Iterator[None]:
    try:
        yield
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as problem:
        raise ArchiveError(f"holds {place.name!r} twice") from problem
