"""Download public data: sigmasplat download."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from sigmasplat.download.entries import PublicSet
    from sigmasplat.run.terminal import Screen

arg = tyro.conf.arg
SetName = Annotated[
    str, tyro.conf.Positional, arg(metavar="SET", help="tum, replica, icl, 7scenes, bonn, redwood; or list")
]
Names = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    arg(metavar="NAME", help="recordings of the set; list SET names them", help_behavior_hint="(none where it is one)"),
]
DataFolder = Annotated[Path, arg(metavar="DIR", help="data folder")]
ListOnly = Annotated[bool, arg(name="list", help="tell what there is, download nothing", help_behavior_hint="")]
Overwrite = Annotated[bool, arg(help="download again what is there already", help_behavior_hint="")]
KeepArchive = Annotated[bool, arg(help="keep the archives beside what was in them", help_behavior_hint="")]


def download(
    dataset: SetName = "list",
    names: Names = (),
    out: DataFolder = Path("data"),
    list_only: ListOnly = False,
    overwrite: Overwrite = False,
    keep_archive: KeepArchive = False,
) -> int:
    """Download recordings of a public data set: resumed where it broke off, checked, unpacked safely.

    example: sigmasplat download tum fr1/desk
    """
    from sigmasplat.download import find_recording
    from sigmasplat.run.terminal import Screen

    screen = Screen()
    if list_only or dataset == "list":
        _tell_what_there_is(screen, names if dataset == "list" else (dataset,))
        return 0
    for public, name in [find_recording(dataset, name) for name in names or ("",)]:
        target = _obtained(screen, public, name, out, overwrite, keep_archive)
        start = target / public.recordings[name].start
        _refuse_unknown(start)
        screen.say(f"next: sigmasplat run {start}")
    return 0


def _tell_what_there_is(screen: "Screen", set_names: tuple[str, ...]) -> None:
    from sigmasplat.download import describe_recordings, describe_sets

    for line in (line for name in set_names for line in describe_recordings(name)) if set_names else describe_sets():
        screen.say(line)


def _obtained(screen: "Screen", public: "PublicSet", name: str, out: Path, overwrite: bool, keep_archive: bool) -> Path:
    from sigmasplat.download import download_recording

    try:
        with screen.transfers() as progress:
            return download_recording(public, name, out, progress, screen.say, overwrite, keep_archive)
    except KeyboardInterrupt:
        screen.say("what has come is kept; the same command goes on with it")
        raise


def _refuse_unknown(folder: Path) -> None:
    """Raise DownloadError if what came cannot be opened as a sequence."""
    from sigmasplat.errors import DownloadError, SourceError
    from sigmasplat.sources import open_source

    try:
        open_source(folder)
    except SourceError as problem:
        raise DownloadError(f"downloaded, but not to be run as it is: {problem}") from problem
