"""Download public data: sigmasplat download."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sigmasplat.commands.input_options import arg, flag
from sigmasplat.errors import DownloadError, SourceError

if TYPE_CHECKING:
    from sigmasplat.plugins.download.catalogue import PublicSet
    from sigmasplat.run.terminal import Screen

Overwrite = Annotated[bool, flag("download existing recordings again")]


def download(
    dataset: Annotated[
        str, tyro.conf.Positional, arg("SET", "tum, replica, icl, 7scenes, bonn, redwood; lpips, netvlad; or list"),
    ] = "list",
    names: Annotated[
        tuple[str, ...], tyro.conf.Positional,
        arg("NAME", "names of recordings; `download list SET` lists them", "(none if there is only one)"),
    ] = (),
    out: Annotated[Path, arg("DIR", "folder for the data sets")] = Path("data"), overwrite: Overwrite = False,
) -> int:  # fmt: skip
    """Download recordings of a public data set, or weights: resumable, verified, safely unpacked.

    example: sigmasplat download tum fr1/desk
    """
    from sigmasplat.plugins.download import describe_recordings, describe_sets, find_recording
    from sigmasplat.plugins.sources import open_source
    from sigmasplat.run.terminal import Screen

    screen = Screen()
    if dataset == "list":
        for line in (line for name in names for line in describe_recordings(name)) if names else describe_sets():
            screen.say(line)
        return 0
    for public_set, name in [find_recording(dataset, name) for name in names or ("",)]:
        target = _download(screen, public_set, name, out, overwrite)
        if public_set.use:
            screen.say(f"next: {public_set.use.format(target=target)}")
            continue
        start = target / public_set.recordings[name].start
        try:
            open_source(start)
        except SourceError as problem:
            raise DownloadError(f"downloaded, but it cannot be run: {problem}") from problem
        screen.say(f"next: sigmasplat run {start}")
    return 0


def _download(screen: "Screen", public_set: "PublicSet", name: str, out: Path, overwrite: bool) -> Path:
    from sigmasplat.plugins.download import download_recording

    try:
        with screen.transfers() as progress:
            return download_recording(public_set, name, out, progress, screen.say, overwrite)
    except KeyboardInterrupt:
        screen.say("the part downloaded so far is kept; the same command resumes the download")
        raise
