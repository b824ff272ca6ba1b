"""Download a recording: fetch, verify and unpack its archives, completely or not at all."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.filesize import decimal

from sigmasplat.api import DownloadError, write_text
from sigmasplat.plugins.download.catalogue import PublicRecording, PublicSet, RemoteFile, format_size
from sigmasplat.plugins.download.fetch import RetryPolicy, fetch
from sigmasplat.plugins.download.unpack import ArchiveError, Budget, is_archive, unpack

if TYPE_CHECKING:
    from sigmasplat.api import Progress

CHUNK_BYTES = 2**20


def verify(path: Path, published: str, progress: "Progress") -> str:
    """Return "algorithm:digest" of a file whose checksum is correct.

    `published` is the expected "algorithm:digest"; the start of a digest is enough (PyTorch publishes eight digits of
    SHA-256 in its file names). If it is "", the digest is compared with `path`.sha256, which is
    written at the first call. If they differ, the file is removed. Raises DownloadError.
    """
    algorithm = published.partition(":")[0] or "sha256"
    found = f"{algorithm}:{_digest(path, algorithm, progress)}"
    record = path.with_name(f"{path.name}.sha256")
    words = record.read_text(encoding="utf-8").split() if record.is_file() else []  # as sha256sum writes them
    wanted = published or (f"sha256:{words[0]}" if words else "")
    if wanted and not found.startswith(wanted):
        path.unlink()
        changed = f"has changed (before {wanted}, now {found}); run it again, or delete {record} to accept it"
        what = f"is {found}, not {wanted}; run it again" if published else changed
        raise DownloadError(f"{path} was damaged and has been removed; its checksum {what}")
    if not wanted:
        write_text(record, f"{found.partition(':')[2]}  {path.name}\n")
    return found


def _digest(path: Path, algorithm: str, progress: "Progress") -> str:
    digest = hashlib.new(algorithm, usedforsecurity=False)  # some publish only MD5: detects damage, not attacks
    done, total = 0, path.stat().st_size
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
            done += len(chunk)
            progress(done, total)
    return digest.hexdigest()


MARKER = ".sigmasplat-download.json"
"""File written last to a downloaded folder; it marks the folder as complete."""
SIZE_MARGIN = 3.0
"""Factor on the expected unpacked size of an archive."""
ROUGH_SIZE_RANGE = (0.5, 1.5)
"""Accepted size of a download, relative to an approximate size."""
FileProgress = Callable[[str, int, int], None]
"""Called with the current action, bytes done, and bytes in total (0: unknown)."""
Log = Callable[[str], None]


@dataclass(frozen=True)
class DownloadJob:
    """The parameters shared by all archives of a recording; archive_folder: where they are stored."""

    public_set: PublicSet
    archive_folder: Path
    progress: FileProgress
    log: Log
    retry: RetryPolicy


def download_recording(
    public_set: PublicSet, name: str, out: Path, progress: FileProgress, log: Log = lambda line: None,
    overwrite: bool = False, keep_archive: bool = False, retry: RetryPolicy | None = None,
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
    job = DownloadJob(public_set, target.parent, progress, log, retry or RetryPolicy())
    with _created(target.parent):
        _download(job, name, target, keep_archive)
    return target


def _download(job: DownloadJob, name: str, target: Path, keep_archive: bool) -> None:
    """Download the archives of a recording and unpack them to `target`."""
    public_set, recording = job.public_set, job.public_set.recordings[name]
    archives = [_verified_file(job, archive) for archive in recording.archives]
    with _replacing(target) as fresh:
        for archive, path in zip(recording.archives, archives, strict=True):
            _unpack_file(job, archive, path, fresh / archive.into)
        _check_layout(fresh / recording.start, recording, archives)
        marks = {"title": public_set.title, "recording": name, "licence": public_set.licence, "page": public_set.page}
        (fresh / MARKER).write_text(json.dumps(marks | {"from": [a.url for a in recording.archives]}, indent=1) + "\n")
    for path in [] if keep_archive else archives:
        path.unlink(missing_ok=True)


def _verified_file(job: DownloadJob, archive: RemoteFile) -> Path:
    """Return the path of a verified archive, downloaded unless it exists."""
    path = job.archive_folder / archive.name
    if not path.exists():
        progress = partial(job.progress, f"download {archive.name}")
        fetch(archive.url, path, progress, partial(_check_size, job, archive), job.retry)
    verify(path, archive.checksum, partial(job.progress, f"check {archive.name}"))
    return path


def _check_size(job: DownloadJob, archive: RemoteFile, size_bytes: int | None, downloaded_bytes: int) -> None:
    """Raise DownloadError if the size of the server's file is not plausible, or the disk has no space for it."""
    expected = archive.size_bytes
    if size_bytes is not None and expected is not None:
        low, high = (1.0, 1.0) if archive.checksum else ROUGH_SIZE_RANGE
        if not low * expected <= size_bytes <= high * expected:
            sizes = f"{size_bytes:,} bytes, not {'' if archive.checksum else 'about '}{expected:,}"
            raise DownloadError(f"the server's {archive.name} has {sizes}; did the data set change?")
    likely = size_bytes if size_bytes is not None else expected or 0
    if likely > job.public_set.max_bytes:
        raise DownloadError(f"the server's {archive.name} has {likely:,} bytes, too many for this data set")
    if expected is None:
        job.log(f"{archive.name}: {format_size(size_bytes)}")
    _check_disk_space(job.archive_folder, likely - downloaded_bytes + int(likely * job.public_set.disk_ratio))


def _unpack_file(job: DownloadJob, archive: RemoteFile, path: Path, into: Path) -> None:
    """Unpack an archive and its nested archives, or copy a plain file. A damaged archive is removed."""
    public_set, size_bytes = job.public_set, path.stat().st_size
    _check_disk_space(job.archive_folder, int(size_bytes * public_set.disk_ratio))
    if not is_archive(path.name):
        shutil.copyfile(path, into)
        return
    budget = Budget(int(SIZE_MARGIN * public_set.disk_ratio * size_bytes) + 2**20, public_set.max_files)
    try:
        unpack(path, into, budget, partial(job.progress, f"unpack {path.name}"))
        _remove_wrapper_folder(into)
        for inner in sorted(into.rglob("*.zip")) if archive.nested else []:
            unpack(inner, inner.parent, budget, partial(job.progress, f"unpack {inner.name}"))
            inner.unlink()
    except ArchiveError as problem:
        path.unlink(missing_ok=True)
        raise ArchiveError(f"{problem}; {path} has been removed, run it again to download it") from problem


def _remove_wrapper_folder(folder: Path) -> None:
    """If a folder contains only one folder, replace it by that folder."""
    entries = list(folder.iterdir())
    if len(entries) != 1 or not entries[0].is_dir():
        return
    wrapping = entries[0].rename(folder.with_name(f"{folder.name}.wrapping"))
    folder.rmdir()
    wrapping.rename(folder)


def _check_layout(start: Path, recording: PublicRecording, archives: list[Path]) -> None:
    if not start.is_dir() or not any(start.iterdir()):
        names = ", ".join(path.name for path in archives)
        raise DownloadError(
            f"{names} does not hold {recording.start or 'anything'}; the layout of the data set has changed"
        )


@contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `target`; it replaces `target` if the block succeeds, else it is removed."""
    fresh, old = (target.with_name(f".{target.name}.{word}") for word in ("unpacking", "old"))
    try:
        _remove(fresh)
        _make_folder(fresh)
        yield fresh
        if target.exists():
            _remove(old)
            target.rename(old)
        fresh.rename(target)
    except OSError as problem:
        raise DownloadError(f"cannot write {target}: {problem.strerror or problem}; is the disk full?") from problem
    finally:
        if old.exists() and not target.exists():
            old.rename(target)
        _remove(fresh)
        _remove(old)


@contextmanager
def _created(folder: Path) -> Iterator[None]:
    """Create a folder with its parents; if the block fails, remove those created here that are still empty."""
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        _make_folder(folder)
        yield
    except BaseException:
        for place in made:
            with suppress(OSError):
                place.rmdir()
        raise


def _remove(folder: Path) -> None:
    if folder.is_symlink():
        folder.unlink()
    shutil.rmtree(folder, ignore_errors=True)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise DownloadError(f"cannot create {folder}: {problem.strerror or problem}; give another --out") from problem


def _check_disk_space(folder: Path, needed_bytes: int) -> None:
    free_bytes = shutil.disk_usage(folder).free
    if needed_bytes > free_bytes:
        room = f"{decimal(needed_bytes)} needed, {decimal(free_bytes)} free"
        raise DownloadError(
            f"not enough disk space in {folder}: {room}; free some space, or give --out on another disk"
        )
