"""Download a recording: fetch, verify and unpack its archives, completely or not at all.

Archives are untrusted: links, names that leave the folder, and too much content are refused.
"""

import gzip
import hashlib
import json
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING

from rich.filesize import decimal

from sigmasplat.api import DownloadError, guarded
from sigmasplat.plugins.download.catalogue import PublicSet, RemoteFile, format_size
from sigmasplat.plugins.download.fetch import fetch

if TYPE_CHECKING:
    from sigmasplat.api import Progress

MARKER = ".sigmasplat-download.json"
"""File written last to a downloaded folder; it marks the folder as complete."""
SIZE_MARGIN = 3.0
"""Factor on the expected unpacked size of an archive."""
FileProgress = Callable[[str, int, int], None]
"""Called with the current action, bytes done, and bytes in total (0: unknown)."""
Log = Callable[[str], None]


def download_recording(
    public_set: PublicSet, name: str, out: Path, progress: FileProgress, log: Log = lambda line: None,
    overwrite: bool = False,
) -> Path:  # fmt: skip
    """Download a recording of a data set, unless it exists already; return its folder below `out`.

    `log` receives the licence and the size first. Downloaded parts are kept on errors and on Ctrl-C, and the next call
    resumes; incomplete folders are removed. Raises DownloadError; RunError if the disk cannot be written.
    """
    recording = public_set.recordings[name]
    target = out / public_set.folder / recording.folder
    if target.exists() or target.is_symlink():
        if not (target / MARKER).is_file():
            raise DownloadError(f"{target} exists and was not created by this command; move it, or give another --out")
        if not overwrite:
            log(f"{target} exists already; --overwrite downloads it again")
            return target
    log(f"{public_set.title} {name}".rstrip() + f": {format_size(recording.size_bytes)} → {target}")
    log(f"terms: {public_set.licence} ({public_set.page}); by downloading you accept them")
    with _writable(target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
    archives = [_verified_file(public_set, archive, target.parent, progress) for archive in recording.archives]
    with _replacing(target) as fresh:
        for archive, path in zip(recording.archives, archives, strict=True):
            _unpack_file(public_set, archive, path, fresh / archive.into, progress)
        start = fresh / recording.start
        if not start.is_dir() or not any(start.iterdir()):
            names = ", ".join(path.name for path in archives)
            raise DownloadError(
                f"{names} does not hold {recording.start or 'anything'}; the layout of the data set has changed"
            )
        marks = {"title": public_set.title, "recording": name, "licence": public_set.licence, "page": public_set.page}
        (fresh / MARKER).write_text(json.dumps(marks | {"from": [a.url for a in recording.archives]}, indent=1) + "\n")
    for path in archives:
        path.unlink(missing_ok=True)
    return target


def _verified_file(public_set: PublicSet, archive: RemoteFile, folder: Path, progress: FileProgress) -> Path:
    """Return the path of a verified archive, downloaded unless it exists."""
    path = folder / archive.name

    def check_size(size_bytes: int | None, here_bytes: int) -> None:
        likely = archive.size_bytes or 0 if size_bytes is None else size_bytes
        _check_disk_space(folder, likely - here_bytes + int(likely * public_set.disk_ratio))

    if not path.exists():
        fetch(archive.url, path, partial(progress, f"download {archive.name}"), check_size)
    if archive.checksum:
        verify(path, archive.checksum, partial(progress, f"check {archive.name}"))
    return path


def verify(path: Path, published: str, progress: Callable[[int, int], None]) -> None:
    """Remove a file and raise DownloadError if its checksum is not the published "algorithm:digest".

    The start of a digest is enough: PyTorch publishes eight digits of SHA-256 in its file names.
    """
    algorithm, size_bytes = published.partition(":")[0], path.stat().st_size
    progress(0, size_bytes)
    with path.open("rb") as file:  # some publish only MD5: detects damage, not attacks
        digest = hashlib.file_digest(file, lambda: hashlib.new(algorithm, usedforsecurity=False))
    found = f"{algorithm}:{digest.hexdigest()}"
    if not found.startswith(published):
        path.unlink()
        what = f"its checksum is {found}, not {published}"
        raise DownloadError(f"{path} was damaged and has been removed; {what}; run it again")
    progress(size_bytes, size_bytes)


def _unpack_file(public_set: PublicSet, archive: RemoteFile, path: Path, into: Path, progress: FileProgress) -> None:
    """Unpack an archive and its nested archives, or copy a plain file. A damaged archive is removed."""
    if not path.name.lower().endswith((".zip", ".tgz", ".tar.gz")):
        shutil.copyfile(path, into)
        return
    likely = int(public_set.disk_ratio * path.stat().st_size)
    _check_disk_space(path.parent, likely)
    most_bytes = int(SIZE_MARGIN * likely) + 2**20
    try:
        unpack(path, into, most_bytes, partial(progress, f"unpack {path.name}"))
        _remove_wrapper_folder(into)
        for inner in sorted(into.rglob("*.zip")) if archive.nested else []:
            unpack(inner, inner.parent, most_bytes, partial(progress, f"unpack {inner.name}"))
            inner.unlink()
    except ArchiveError as problem:
        path.unlink(missing_ok=True)
        raise ArchiveError(f"{problem}; {path} has been removed, run it again to download it") from problem


def _remove_wrapper_folder(folder: Path) -> None:
    """If a folder contains only one folder, replace it by that folder."""
    entries = list(folder.iterdir())
    if len(entries) == 1 and entries[0].is_dir():
        wrapping = entries[0].rename(folder.with_name(f"{folder.name}.wrapping"))
        folder.rmdir()
        wrapping.rename(folder)


def _writable(place: Path) -> AbstractContextManager[None]:
    return guarded(place, "free some space, or give another --out", DownloadError, "cannot be written")


@contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `target`; it replaces `target` if the block succeeds, else it is removed."""
    fresh = target.with_name(f".{target.name}.unpacking")
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        with _writable(target):
            fresh.mkdir()
            yield fresh
            shutil.rmtree(target, ignore_errors=True)
            fresh.rename(target)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _check_disk_space(folder: Path, needed_bytes: int) -> None:
    free_bytes = shutil.disk_usage(folder).free
    if needed_bytes > free_bytes:
        room = f"{decimal(needed_bytes)} needed, {decimal(free_bytes)} free"
        raise DownloadError(
            f"not enough disk space in {folder}: {room}; free some space, or give --out on another disk"
        )


CHUNK_BYTES = 2**20
DAMAGE = (
    tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, FileExistsError, NotADirectoryError, IsADirectoryError,
)  # fmt: skip
DESKTOP_FILES = {"__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"}


class ArchiveError(DownloadError):
    """The archive is damaged or unsafe."""


def unpack(archive: Path, folder: Path, most_bytes: int, progress: "Progress") -> None:
    """Unpack a .tar.gz or .zip to `folder`, which is created; progress(done, total) counts the archive's bytes.

    Raises ArchiveError if the archive is damaged, holds links or names outside the folder, or more than `most_bytes`;
    DownloadError if the disk is full. Files written before the error remain, so use a temporary folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        unpacked = _unpack_zip if archive.name.lower().endswith(".zip") else _unpack_tar
        unpacked(archive, folder, most_bytes, progress)
        progress(archive.stat().st_size, archive.stat().st_size)
    except ArchiveError as problem:
        raise ArchiveError(f"{archive.name} {problem}; it is refused, and no file of it is kept") from problem
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
            if (place := _place(folder, member.name)) and (source := tar.extractfile(member)):
                _write(place, source)
            progress(min(packed.tell(), size_bytes - 1), size_bytes)
        while tar.fileobj.read(CHUNK_BYTES):  # to the end, where the checksum is
            pass


def _unpack_zip(archive: Path, folder: Path, most_bytes: int, progress: "Progress") -> None:
    with zipfile.ZipFile(archive) as zipped:
        done, entries = 0, zipped.infolist()
        for entry in entries:  # check the headers before anything is written
            most_bytes = _less(most_bytes, entry.file_size)
            if stat.S_ISLNK(entry.external_attr >> 16):
                raise ArchiveError(f"holds {entry.filename!r}, which is not a plain file or folder")
        for entry in entries:
            if (place := _place(folder, entry.filename)) and not entry.is_dir():
                with zipped.open(entry) as source:
                    _write(place, source)
            done += entry.compress_size
            progress(done, archive.stat().st_size)


def _place(folder: Path, name: str) -> Path | None:
    """Return where a file is written, None for a desktop's own files. Raises ArchiveError if it is not below `folder`.
    Separators may be those of Windows."""
    parts = name.replace("\\", "/").split("/")
    if name.startswith(("/", "\\")) or ".." in parts or parts[0].endswith(":"):
        raise ArchiveError(f"holds {name!r}, a name that leaves the folder")
    litter = DESKTOP_FILES.intersection(parts) or parts[-1].startswith("._")
    return None if litter else folder.joinpath(*parts)


def _write(place: Path, source: IO[bytes]) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("wb") as file:
        shutil.copyfileobj(source, file)


def _less(most_bytes: int, size_bytes: int) -> int:
    if size_bytes > most_bytes:
        raise ArchiveError("holds more bytes than expected for this data set")
    return most_bytes - size_bytes
