"""Keep other pages of the same browser out: they may open websockets to any address, and read what comes back."""

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
    """Tell whether a request with these headers, Origin and Host, comes from a page of the viewer at `host`, or from
    no page at all (no Origin).

    The page's address must be the one that the request goes to, and that an IP address or a name of the viewer's: any
    other name may be made to point here by whoever owns it.
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
    """Answer 403 to requests of other pages, in websocket servers that are started meanwhile; list where they listen.

    viser starts one and lets nobody say how, so websockets' `serve` stands in for itself until it has.
    """
    from websockets.asyncio import server

    plain, kept = server.serve, list[str]()

    def serve(*args: Any, process_request: "Answer", **more: Any) -> "server.serve":
        def answer(connection: "ServerConnection", request: "Request") -> "Response | None":
            if not is_own_page(request.headers.get("Origin"), request.headers.get("Host"), host):
                return connection.respond(403, "this page is not the viewer's\n")
            return process_request(connection, request)

        kept.append(host)
        return plain(*args, process_request=answer, **more)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield kept
    finally:
        server.serve = plain  # type: ignore[misc]
