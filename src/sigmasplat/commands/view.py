"""Show a run in the browser: sigmasplat view, and sigmasplat run --view."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.options import prepare_torch, source_of
from sigmasplat.errors import SigmaSplatError
from sigmasplat.viewer.server import HOST, PORT, close, is_private, open_server, url_of

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.terminal import Screen
    from sigmasplat.sources.base import Source
    from sigmasplat.viewer.app import Stage


def view(run: options.RunPath, host: options.Host = HOST, port: options.Port = PORT) -> int:
    """Look at a run in the browser: map, path, uncertainty. A run that goes on is followed.

    example: sigmasplat view runs/kitchen-sigma
    """
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.terminal import Screen
    from sigmasplat.viewer.finished import follow, refuse_mapless

    folder = RunFolder.open(run)
    refuse_mapless(folder)
    prepare_torch()
    with on_stage(Screen(), host, port) as stage:
        try:
            follow(folder, stage.show, threading.Event(), source_where_it_was(folder))
            threading.Event().wait()
        except KeyboardInterrupt:
            pass
    return 0


@contextmanager
def on_stage(screen: "Screen", host: str, port: int) -> Iterator["Stage"]:
    """Serve a stage to browsers, empty at first, and say where; close it at the end.

    Raises SigmaSplatError without viser or where the port cannot be had.
    """
    server = open_server(host, port, "SigmaSplat")
    from sigmasplat.viewer.app import Stage

    stage, found = Stage(server), server.get_port()
    try:
        if port and found != port:
            screen.say(f"port {port} is taken, so it is {found}")
        if not is_private(host):
            screen.warn(f"whoever reaches {host} can look at the run; leave out --host to keep it to this machine")
        screen.say(f"viewer: {url_of(host, found)} (Ctrl-C ends it)")
        yield stage
    finally:
        stage.stop()
        close(server)


def stay(screen: "Screen", stage: "Stage", folder: "RunFolder", source: "Source") -> None:
    """Show a run that has ended until Ctrl-C."""
    from sigmasplat.viewer.finished import ended

    try:
        stage.show(ended(folder, source))
        screen.say("the run stays in the browser; Ctrl-C ends the viewer")
        threading.Event().wait()
    except KeyboardInterrupt:
        pass


def source_where_it_was(folder: "RunFolder") -> "Source | None":
    """Open the sequence of a run for its pictures, None where it is not there any more."""
    try:
        return source_of(folder, None)
    except SigmaSplatError:
        return None
