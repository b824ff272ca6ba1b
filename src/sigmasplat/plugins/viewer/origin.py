"""Refuse other pages in the same browser: any page may open a websocket to any address and read the answers."""

import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Answer = Callable[[ServerConnection, Request], Response | None]


def is_own_page(origin: str | None, reached: str | None, host: str) -> bool:
    """Return whether a request with the headers Origin and Host comes from a page of the viewer at `host`.

    Also true without an Origin: the client is not a browser. The page's address must equal the requested one, and it
    must be an IP address or a name of the viewer's host: the owner of any other name can point that name to this
    machine.
    """
    if origin is None:
        return True
    try:
        page, name = urlsplit(origin.lower()), urlsplit(origin.lower()).hostname or ""
    except ValueError:
        return False
    if page.scheme not in ("http", "https") or reached is None or page.netloc != reached.lower():
        return False
    machine = socket.gethostname().lower()
    return name in ("localhost", host.lower(), machine, f"{machine}.local") or _is_ip(name)


def _is_ip(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


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
