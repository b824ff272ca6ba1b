"""Show a run in the browser: sigmasplat view, and sigmasplat run --view."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.options import prepare_torch
from sigmasplat.plugins.viewer.server import HOST, PORT, close, is_loopback, open_server, url_of

if TYPE_CHECKING:
    from sigmasplat.plugins.viewer.app import ViewerApp
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder


def view(run: options.RunPath, host: options.Host = HOST, port: options.Port = PORT) -> int:
    """Show a run in the browser: map, path, uncertainty, distances. It opens at the view that shows most.

    example: sigmasplat view runs/kitchen-sigma
    """
    from sigmasplat.plugins.viewer.snapshot_sources import finished_snapshot
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder

    prepare_torch()
    snapshot = finished_snapshot(RunFolder.open(run))
    with serve_viewer(Screen(), host, port) as viewer, suppress(KeyboardInterrupt):
        viewer.show(snapshot)
        threading.Event().wait()
    return 0


@contextmanager
def serve_viewer(screen: "Screen", host: str, port: int) -> Iterator["ViewerApp"]:
    """Start an empty viewer and print its address; stop it at the end of the block.

    Raises SigmaSplatError if viser is missing or no port is free.
    """
    server = open_server(host, port, "SigmaSplat")
    from sigmasplat.plugins.viewer.app import ViewerApp

    viewer, found = ViewerApp(server), server.get_port()
    try:
        if port and found != port:
            screen.say(f"port {port} is busy, using {found}")
        if not is_loopback(host):
            screen.warn(f"anyone who can reach {host} can view the run; omit --host to allow only this machine")
        screen.say(f"viewer: {url_of(host, found)} (press Ctrl-C to stop)")
        yield viewer
    finally:
        viewer.stop()
        close(server)


def keep_showing(screen: "Screen", viewer: "ViewerApp", folder: "RunFolder") -> None:
    """Keep showing a finished run until Ctrl-C."""
    from sigmasplat.plugins.viewer.snapshot_sources import finished_snapshot

    try:
        viewer.show(finished_snapshot(folder))
        screen.say("the viewer keeps showing the run; press Ctrl-C to stop it")
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
