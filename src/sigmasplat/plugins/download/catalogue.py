"""The public data sets of sets.toml (addresses, sizes, licences): list them, and find them by name."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

from rich.filesize import decimal

from sigmasplat.api import DownloadError, nearest


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
    """A data set; without recordings it is available only on request.

    page: about it, and where to apply; folder: below the data folder; recordings: by short name, "" if there is only
    one; disk_ratio: bytes on disk during unpacking, per byte of the archive; prefix: optional prefix of the short
    names; use: of weights: the command that uses them, with their folder as {target}.
    """

    title: str
    page: str
    licence: str = ""
    folder: str = ""
    recordings: Mapping[str, PublicRecording] = field(default_factory=dict)
    disk_ratio: float = 1.3
    prefix: str = ""
    use: str = ""


def _read_sets(text: str) -> dict[str, PublicSet]:
    found = {}
    for name, fields in tomllib.loads(text).items():
        address, made = fields.pop("address", ""), {}
        for short, row in fields.pop("recordings", {}).items():
            files = tuple(RemoteFile(address + file.pop("at"), **file) for file in row.pop("files"))
            made[short] = PublicRecording(archives=files, **row)
        found[name] = PublicSet(recordings=made, **fields)
    return found


SETS: Mapping[str, PublicSet] = _read_sets(Path(__file__).with_name("sets.toml").read_text(encoding="utf-8"))


def find_recording(set_name: str, recording: str = "") -> tuple[PublicSet, str]:
    """Return a data set and the short name of one of its recordings, "" if it has only one.

    Names may be written as in papers and files: freiburg1_desk, fr1_desk, rgbd_dataset_freiburg1_desk.
    Raises DownloadError if there is no such data set or recording, or if it is available only on request.
    """
    public_set = _find_set(set_name)
    if set(public_set.recordings) == {""}:
        if recording:
            raise DownloadError(f"{set_name} is one archive, without a recording {recording!r}; leave out the name")
        return public_set, ""
    names = {_normalised(name, public_set.prefix): name for name in public_set.recordings}
    known = names.get(_normalised(recording, public_set.prefix))
    if known is None:
        wanted = f"no recording {recording!r} in {set_name}" if recording else f"give a recording of {set_name}"
        raise DownloadError(f"{wanted}{_suggestion(recording, list(public_set.recordings))}")
    return public_set, known


def describe_sets() -> Iterator[str]:
    """Yield a line per data set: name, title, number of recordings, licence."""
    for name, entry in sorted(SETS.items()):
        if entry.recordings:
            first, *others = entry.recordings.values()
            count = f"{1 + len(others)} recordings" if others else f"one download, {format_size(first.size_bytes)}"
            yield f"{name:<10} {entry.title} · {count} · {entry.licence}"
        else:
            yield f"{name:<10} {entry.title} · on request: {entry.page}"


def describe_recordings(set_name: str) -> Iterator[str]:
    """Yield a line per recording of a data set: name and size. Raises DownloadError if there is no such data set."""
    for name, recording in _find_set(set_name).recordings.items():
        yield f"{name or recording.folder:<36} {format_size(recording.size_bytes)}"


def format_size(size_bytes: int | None) -> str:
    """Format a number of bytes with a unit; None gives "size not published"."""
    return "size not published" if size_bytes is None else decimal(size_bytes)


def _find_set(set_name: str) -> PublicSet:
    entry = SETS.get(set_name.lower())
    if entry is None:
        raise DownloadError(f"no data set {set_name!r}{_suggestion(set_name, sorted(SETS))}")
    if not entry.recordings:
        raise DownloadError(
            f"{entry.title} is available only on request: apply at {entry.page}, then `sigmasplat run FOLDER`"
        )
    return entry


def _normalised(name: str, prefix: str) -> str:
    """Normalise a name: fr1/desk, freiburg1_desk and rgbd_dataset_freiburg1_desk are equal."""
    return name.lower().removeprefix(prefix).replace("freiburg", "fr").replace("/", "_").replace("-", "_")


def _suggestion(wanted: str, names: list[str]) -> str:
    """Return the nearest name, else all names."""
    return nearest(wanted, names) or f"; there are {', '.join(names)}"
