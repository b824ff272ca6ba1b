"""Look a public data set up by name, and tell what there is."""

import difflib
from collections.abc import Iterator

from rich.filesize import decimal

from sigmasplat.download.catalogue import SETS
from sigmasplat.download.entries import PublicSet
from sigmasplat.errors import DownloadError


def find_recording(set_name: str, recording: str = "") -> tuple[PublicSet, str]:
    """Return a set and the short name of one of its recordings, "" where it has one only.

    Names are also found written as in papers and files: freiburg1_desk, fr1_desk, rgbd_dataset_freiburg1_desk.
    Raises DownloadError if there is no such set or recording, or if its owners want to be asked.
    """
    public = _find_set(set_name)
    if set(public.recordings) == {""}:
        if recording:
            raise DownloadError(f"{set_name} comes whole, in one archive, not {recording!r}; leave the name out")
        return public, ""
    names = {_normalised(name, public.prefix): name for name in public.recordings}
    known = names.get(_normalised(recording, public.prefix))
    if known is None:
        wanted = f"no recording {recording!r} in {set_name}" if recording else f"say which recording of {set_name}"
        raise DownloadError(f"{wanted}; {_suggestion(recording, list(public.recordings))}")
    return public, known


def describe_sets() -> Iterator[str]:
    """Yield a line per set: its name, what it is, how many recordings, under which terms."""
    for name, entry in sorted(SETS.items()):
        if isinstance(entry, PublicSet):
            many = len(entry.recordings)
            count = f"{many} recordings" if many > 1 else f"one archive, {format_size(entry.recordings[''].size_bytes)}"
            yield f"{name:<10} {entry.title} · {count} · {entry.licence}"
        else:
            yield f"{name:<10} {entry.title} · ask at {entry.page}"


def describe_recordings(set_name: str) -> Iterator[str]:
    """Yield a line per recording of a set: its name and size. Raises DownloadError if there is no such set."""
    for name, recording in _find_set(set_name).recordings.items():
        yield f"{name or recording.folder:<36} {format_size(recording.size_bytes)}"


def format_size(size_bytes: int | None) -> str:
    """Write a number of bytes for people, or that nobody says."""
    return "size not published" if size_bytes is None else decimal(size_bytes)


def _find_set(set_name: str) -> PublicSet:
    entry = SETS.get(set_name.lower())
    if isinstance(entry, PublicSet):
        return entry
    if entry is None:
        raise DownloadError(f"no data set {set_name!r}; {_suggestion(set_name, sorted(SETS))}")
    raise DownloadError(f"{entry.title} is given on request only: ask at {entry.page}, then `sigmasplat run FOLDER`")


def _normalised(name: str, prefix: str) -> str:
    """Reduce the ways to write a name to one: fr1/desk, freiburg1_desk and rgbd_dataset_freiburg1_desk are the same."""
    written = name.lower().removeprefix(prefix).replace("freiburg", "fr")
    return written.replace("/", "_").replace("-", "_")


def _suggestion(wanted: str, names: list[str]) -> str:
    near = difflib.get_close_matches(wanted, names, n=3) if wanted else []
    return f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names)}"
