"""Find public data sets and recordings by name, and list them."""

import difflib
from collections.abc import Iterator

from rich.filesize import decimal

from sigmasplat.errors import DownloadError
from sigmasplat.plugins.download.catalogue import SETS
from sigmasplat.plugins.download.entries import PublicSet


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
        raise DownloadError(f"{wanted}; {_suggestion(recording, list(public_set.recordings))}")
    return public_set, known


def describe_sets() -> Iterator[str]:
    """Yield a line per data set: name, title, number of recordings, licence."""
    for name, entry in sorted(SETS.items()):
        if isinstance(entry, PublicSet):
            many = len(entry.recordings)
            count = f"{many} recordings" if many > 1 else f"one archive, {format_size(entry.recordings[''].size_bytes)}"
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
    if isinstance(entry, PublicSet):
        return entry
    if entry is None:
        raise DownloadError(f"no data set {set_name!r}; {_suggestion(set_name, sorted(SETS))}")
    raise DownloadError(
        f"{entry.title} is available only on request: apply at {entry.page}, then `sigmasplat run FOLDER`"
    )


def _normalised(name: str, prefix: str) -> str:
    """Normalise a name: fr1/desk, freiburg1_desk and rgbd_dataset_freiburg1_desk are equal."""
    written = name.lower().removeprefix(prefix).replace("freiburg", "fr")
    return written.replace("/", "_").replace("-", "_")


def _suggestion(wanted: str, names: list[str]) -> str:
    near = difflib.get_close_matches(wanted, names, n=3) if wanted else []
    return f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names)}"
