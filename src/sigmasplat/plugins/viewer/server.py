"""Start the viewer's server, by default for this machine only, on the requested port or the next free one.

It refuses other pages in the same browser: any page may open a websocket to any address and read the answers.
"""

import contextlib
import errno
import io
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from sigmasplat.api import ConfigError, SigmaSplatError, install_extra

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Answer = Callable[[ServerConnection, Request], Response | None]
    from viser import ViserServer


def is_own_page(origin: str | None, reached: str | None, host: str) -> bool:
    """Return whether a request with the headers Origin and Host comes from a page of the viewer at `host`.

    Also true without an Origin: the client is not a browser. The page's address must equal the requested one, and it
    must be an IP address or a name of the viewer's host: the owner of another name can point it to this machine.
    """
    if origin is None:
        return True
    try:
        page = urlsplit(origin.lower())
        name = page.hostname or ""
    except ValueError:
        return False
    if page.scheme not in ("http", "https") or reached is None or page.netloc != reached.lower():
        return False
    machine = socket.gethostname().lower()
    return name in ("localhost", host.lower(), machine, f"{machine}.local") or _ip(name) is not None


def _ip(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


@contextmanager
def own_pages_only(host: str) -> Iterator[list[str]]:
    """Make websocket servers that start within the block answer other pages with 403; yield the list of their hosts.

    viser starts such a server and has no option for this, so `serve` of websockets is replaced within the block.
    """
    from websockets.asyncio import server

    original, hosts = server.serve, list[str]()

    def serve(*args: Any, process_request: "Answer", **more: Any) -> "server.serve":
        def answer(connection: "ServerConnection", request: "Request") -> "Response | None":
            if not is_own_page(request.headers.get("Origin"), request.headers.get("Host"), host):
                return connection.respond(403, "this page does not belong to the viewer\n")
            return process_request(connection, request)

        hosts.append(host)
        return original(*args, process_request=answer, **more)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield hosts
    finally:
        server.serve = original  # type: ignore[misc]


HOST, PORT = "127.0.0.1", 8080
ATTEMPTS = 100


def open_server(host: str, port: int, title: str) -> "ViserServer":
    """Start viser's server on the first free port from `port` upwards; it accepts requests of its own pages only.

    Raises SigmaSplatError if viser is missing or cannot be restricted to its own pages, or if no port is free.
    """
    try:
        import viser
    except ImportError as problem:
        raise SigmaSplatError(
            f"the viewer needs viser ({problem}); install it with: {install_extra('viewer')}"
        ) from problem

    class LocalServer(viser.ViserServer):
        """Refuses to share: viser would open a public tunnel if a page asked for one."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    found = free_port(host, port)
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # do not log clients that disconnect
    with own_pages_only(host) as restricted, contextlib.redirect_stdout(io.StringIO()):  # no banner from viser
        server = LocalServer(host=host, port=found, label=title, verbose=False)
    if not restricted:
        close(server)
        raise SigmaSplatError(
            f"viser {viser.__version__} would show the run to any page open in the browser; install viser==1.1.1, the "
            "tested version"
        )
    return server


def close(server: "ViserServer") -> None:
    """Stop a server without its closing message."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def free_port(host: str, port: int) -> int:
    """Return the first free port of a host from `port` upwards; 0 means any.

    Raises ConfigError if the number is out of range, SigmaSplatError if no port is free or the host's address does not
    belong to this machine.
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
            if problem.errno != errno.EADDRINUSE:
                raise SigmaSplatError(
                    f"cannot listen on {host} ({problem.strerror or problem}); give an address of this machine as "
                    f"--host, or {HOST} to allow only this machine"
                ) from problem
    raise SigmaSplatError(f"no free port from {port} to {candidate}; give another --port")


def url_of(host: str, port: int) -> str:
    """Return the address to open in a browser on this machine."""
    reached = {"0.0.0.0": HOST, "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{reached}:{port}"


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached from this machine only."""
    ip = _ip(host)
    return host == "localhost" or (ip is not None and ip.is_loopback)
