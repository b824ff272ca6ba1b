"""Open the port that the viewer listens on: this machine's own by default, the next one where it is taken."""

import contextlib
import errno
import io
import logging
import socket
from typing import TYPE_CHECKING

from sigmasplat.env import install_extra
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.viewer.origin import own_pages_only

if TYPE_CHECKING:
    from viser import ViserServer

HOST, PORT = "127.0.0.1", 8080
ATTEMPTS = 100
TAKEN = (errno.EADDRINUSE,)


def open_server(host: str, port: int, title: str) -> "ViserServer":
    """Start viser's server on the first free port from `port` on, for its own pages only (`origin`).

    Raises SigmaSplatError without viser or a port, or with a viser that cannot be kept to its own pages.
    """
    try:
        import viser
    except ImportError as problem:
        raise SigmaSplatError(
            f"the viewer needs viser ({problem}); install it with: {install_extra('viewer')}"
        ) from problem

    class LocalServer(viser.ViserServer):
        """Shows nothing to anyone outside: viser would open a public tunnel for whoever asks a server for one."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    found = free_port(host, port)
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # a browser that hangs up is no news
    with own_pages_only(host) as kept, contextlib.redirect_stdout(io.StringIO()):  # its banner: our line says where
        server = LocalServer(host=host, port=found, label=title, verbose=False)
    if not kept:
        close(server)
        raise SigmaSplatError(
            f"viser {viser.__version__} would show the run to any page open in the browser; install viser==1.1.1, with "
            "which this was tried"
        )
    return server


def close(server: "ViserServer") -> None:
    """Stop a server without its word of farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def free_port(host: str, port: int) -> int:
    """Return the first free port of a host from `port` on, 0 for any.

    Raises ConfigError if there is no such port, SigmaSplatError if none is free or the host is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port must be from 0 to 65535, found {port}")
    for candidate in range(port, min(port + ATTEMPTS, 65536)):
        try:
            with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
                return candidate
        except PermissionError:
            continue
        except OSError as problem:
            if problem.errno not in TAKEN:
                raise SigmaSplatError(
                    f"cannot listen on {host} ({problem.strerror or problem}); give an address of this machine as "
                    f"--host, {HOST} for none but yourself"
                ) from problem
    raise SigmaSplatError(f"no free port from {port} to {candidate}; give another --port")


def url_of(host: str, port: int) -> str:
    """Return what to open in a browser on this machine."""
    reached = {"0.0.0.0": HOST, "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{reached}:{port}"


def is_private(host: str) -> bool:
    """Tell whether an address is one that other machines do not reach."""
    return host in ("localhost", "::1") or host.startswith("127.")
