"""A file server on 127.0.0.1 for tests; each request can be answered correctly or with a chosen fault."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Request(BaseHTTPRequestHandler):
    """One request; `server.files` are the files, `server.acts` the behaviour for the next requests."""

    protocol_version = "HTTP/1.1"
    server: "FileServer"

    def do_GET(self) -> None:
        self.server.ranges.append(self.headers.get("Range", ""))
        act = self.server.acts.pop(0) if self.server.acts else whole
        self.close_connection = True
        with suppress(BrokenPipeError, ConnectionResetError):  # the client closed the connection
            act(self)

    def body(self) -> bytes:
        return self.server.files[self.path]

    def start(self, status: int = 200, **headers: object) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()

    def log_message(self, *arguments: object) -> None:
        """Log nothing."""


class FileServer(ThreadingHTTPServer):
    """Serves `files` by path; `ranges` are the Range headers of the requests so far."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Request)
        self.files: dict[str, bytes] = {}
        self.acts: list[Act] = []
        self.ranges: list[str] = []

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}{path}"


Act = Callable[[Request], None]


@contextmanager
def serving() -> Iterator[FileServer]:
    """Run a server in a thread."""
    with FileServer() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def _open(request: Request) -> bytes:
    """Send the headers of a correct response; return its body."""
    body, asked = request.body(), request.headers.get("Range", "")
    if not asked:
        request.start(Content_Length=len(body))
        return body
    start = int(asked.removeprefix("bytes=").rstrip("-"))
    request.start(206, Content_Length=len(body) - start, Content_Range=f"bytes {start}-{len(body) - 1}/{len(body)}")
    return body[start:]


def whole(request: Request) -> None:
    """Answer correctly: ranges, 404."""
    if request.path not in request.server.files:
        return status(404)(request)
    request.wfile.write(_open(request))


def drop_after(count: int) -> Act:
    """Close the connection after `count` bytes of the body."""
    return lambda request: request.wfile.write(_open(request)[:count]) and None


def without_ranges(request: Request) -> None:
    """Send the whole file even if a range was requested."""
    request.start(Content_Length=len(request.body()))
    request.wfile.write(request.body())


def wrong_range(request: Request) -> None:
    """Send another range than requested."""
    body = request.body()
    request.start(206, Content_Length=3, Content_Range=f"bytes 0-2/{len(body)}")
    request.wfile.write(body[:3])


def says_length(change: int) -> Act:
    """Send a Content-Length that is wrong by `change`."""

    def act(request: Request) -> None:
        request.start(Content_Length=len(request.body()) + change)
        request.wfile.write(request.body())

    return act


def status(code: int, **headers: object) -> Act:
    """Answer with a status and no body."""
    return lambda request: request.start(code, Content_Length=0, **headers)


def web_page(request: Request) -> None:
    """Answer with a login page."""
    request.start(Content_Type="text/html; charset=utf-8", Content_Length=5)
    request.wfile.write(b"login")


def silence(seconds: float) -> Act:
    """Send no answer for some seconds."""
    return lambda request: time.sleep(seconds)


def chunked(broken: bool) -> Act:
    """Send the file in chunks without Content-Length; if `broken`, the last chunk is missing."""

    def act(request: Request) -> None:
        body = request.body()
        request.start(Transfer_Encoding="chunked")
        for part in (body[:10], body[10:]):
            request.wfile.write(f"{len(part):x}\r\n".encode() + part + b"\r\n")
        if not broken:
            request.wfile.write(b"0\r\n\r\n")

    return act


def endless(request: Request) -> None:
    """Send no length; close the connection at the end."""
    request.start(Connection="close")
    request.wfile.write(request.body())


def sends_on(location: str) -> Act:
    """Redirect."""
    return status(302, Location=location)
