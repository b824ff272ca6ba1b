"""Carry a run through to its end: watched on the terminal and in the browser, kept now and then, scored."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands.evaluate import score
from sigmasplat.commands.options import RunOptions, source_of
from sigmasplat.commands.view import keep_showing, serve_viewer

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.resume import Begun
    from sigmasplat.run.terminal import Screen
    from sigmasplat.sources.base import Source
    from sigmasplat.sources.live import LiveSource
    from sigmasplat.viewer.app import ViewerApp

OK, INTERRUPTED = 0, 130


def optional_viewer(screen: "Screen", ways: RunOptions) -> AbstractContextManager["ViewerApp | None"]:
    """Start the viewer if it is asked for. Raises the same errors as `serve_viewer`."""
    return serve_viewer(screen, ways.host, ways.port) if ways.view else nullcontext()


@contextmanager
def nothing_left_of(run: "RunFolder") -> Iterator[None]:
    """Remove a run just begun if the block fails before anything is kept: not where there is a log, a recording, or a
    file of the user's. The folder goes with it, and runs/ where that was all in it."""
    from sigmasplat.run.session import RUNS

    try:
        yield
    except BaseException:
        born = [run.path / "config.json", run.path / "run.json"]  # that it is ours is the last that is lost of it
        if {*run.path.rglob("*")} <= {run.images, *born}:
            for file in born:
                file.unlink(missing_ok=True)
            for folder in (run.images, run.path, RUNS):
                with suppress(OSError):
                    folder.rmdir()
        raise


def announce(screen: "Screen", preset: str, source: "Source", folder: "RunFolder", record: Path | None) -> None:
    """Say what is run where; a live camera is recorded to `record`, or into the run folder, to be read again later."""
    from sigmasplat.run.session import free
    from sigmasplat.sources.live import LiveSource

    if not isinstance(source, LiveSource):
        screen.say(f"{source.name}: {len(source)} frames, {preset} → {folder.path}")
        return
    place = record or free(folder.path / "recording")
    if not record:
        source.record_to(place)
    folder.note(source_path=str(place.resolve()))
    screen.say(f"{source.name}: until Ctrl-C, {preset} → {folder.path}, recorded to {place}")


def run_and_score(
    screen: "Screen",
    begun: "Begun",
    source: "Source",
    folder: "RunFolder",
    ways: RunOptions,
    viewer: "ViewerApp | None",
) -> int:
    """Run SLAM into the folder, show it in the viewer if there is one, then score it; return the exit code.

    Raises KeyboardInterrupt where Ctrl-C came before the first frame was done.
    """
    from sigmasplat.render.cuda import stages as cuda_stages
    from sigmasplat.run.protocols import Callback, CallbackList
    from sigmasplat.run.resume import Snapshots
    from sigmasplat.run.session import record
    from sigmasplat.sources.live import LiveSource

    cuda_stages.measure(ways.profile)
    keeper = Snapshots(begun.slam, folder, ways.save_every)
    with screen.steps(None if source.live else len(source), begun.next_index) as steps:
        watch: Callback = steps
        if viewer:
            from sigmasplat.viewer.live import LiveView

            watch = CallbackList(steps, LiveView(begun.slam, viewer.show, source.name))
        outcome = record(begun.slam, source, folder, watch, keeper, begun.next_index, begun.wall_s)
    if outcome.status == "interrupted" and not outcome.frames:
        raise KeyboardInterrupt  # there is nothing to tell of, nor to go on with
    if ways.profile:
        screen.profile(folder.read_profile())
    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} unreadable {images} passed over (first: {source.skipped[0]})")
    if outcome.status == "interrupted":
        screen.say(
            f"interrupted after {outcome.counts()}; trajectory, map and checkpoint so far are in {folder.path}, "
            f"`sigmasplat resume {folder.path}` goes on"
        )
        return INTERRUPTED
    if isinstance(source, LiveSource):
        _tell_ending(screen, source)
        source = source_of(folder, None)
    if ways.evaluate:
        score(screen, folder, source)
    else:
        screen.say(f"{outcome.counts()}: {folder.path}")
    if viewer:
        keep_showing(screen, viewer, folder, source)
    return OK


def _tell_ending(screen: "Screen", source: "LiveSource") -> None:
    """Say why the camera ended, and what was left out because SLAM was slower."""
    if source.ending:
        screen.warn(source.ending)
    if source.dropped:
        screen.say(f"{source.dropped} frames of the camera were left out while SLAM was busy")
