"""Fetch a file over HTTP: resumed where it broke, tried again, and under its own name only once it is whole."""

import http.client
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from email.message import Message
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from sigmasplat.download.partial import PartialFile, RemoteVersion, open_partial
from sigmasplat.errors import DownloadError

if TYPE_CHECKING:
    from sigmasplat.types import Progress

CHUNK_BYTES = 2**18
RETRIED_CODES = {408, 425, 429, 500, 502, 503, 504}
RANGE_NOT_SATISFIABLE = 416
CheckSize = Callable[[int | None, int], None]
"""Asked with the size that the server names (None: none) and the bytes that are here; raises to refuse."""


@dataclass(frozen=True)
class RetryPolicy:
    """How long to wait, and how often to try.

    timeout_s: without an answer, or with fewer than `min_bytes_per_s`; max_attempts: in a row that brought less than
    `progress_bytes`; first_wait_s: before the next one, doubled up to max_wait_s.
    """

    timeout_s: float = 30.0
    min_bytes_per_s: float = 500.0
    max_attempts: int = 6
    progress_bytes: int = 2**20
    first_wait_s: float = 1.0
    max_wait_s: float = 30.0


class _TransferError(Exception):
    """A try failed; another may not. hopeless: not where nothing has come yet (no network, no such host)."""

    def __init__(self, why: str, wait_s: float = 0.0, hopeless: bool = False) -> None:
        super().__init__(why)
        self.wait_s, self.hopeless = wait_s, hopeless


def fetch(url: str, target: Path, progress: "Progress", accept: CheckSize, retry: RetryPolicy) -> None:
    """Download `url` to `target`, going on with what an earlier call left in `target`.part.

    What has come is kept on Ctrl-C and on every error. Raises DownloadError.
    """
    with open_partial(target) as part:
        failures = 0
        while True:
            before = part.size_bytes
            try:
                _continue(url, part, progress, accept, retry)
                break
            except _TransferError as broken:
                gained = part.size_bytes - before
                failures = 0 if gained >= retry.progress_bytes else failures + 1
                if failures >= retry.max_attempts or (broken.hopeless and not part.size_bytes):
                    raise DownloadError(f"{broken}{_resume_hint(part)}") from broken
                time.sleep(_wait_s(failures, broken.wait_s, retry))
        part.finish()


def _resume_hint(part: PartialFile) -> str:
    return f"; {part.size_bytes:,} bytes are kept, run it again to go on" if part.size_bytes else ""


def _wait_s(failures: int, asked_s: float, retry: RetryPolicy) -> float:
    waited = retry.first_wait_s * 2.0 ** max(failures - 1, 0)
    return min(max(waited, asked_s), retry.max_wait_s)


def _continue(url: str, part: PartialFile, progress: "Progress", accept: CheckSize, retry: RetryPolicy) -> None:
    """Ask for what is missing and write it. Raises _Broken if not all of it comes."""
    origin = part.origin(url)
    if origin and origin.size_bytes == part.size_bytes:
        return
    with _request(url, origin, part, retry) as response:
        size_bytes = _prepare(url, response, part, origin)
        accept(size_bytes, part.size_bytes)
        _receive(response, part, size_bytes, progress, retry)
    if size_bytes is not None and part.size_bytes != size_bytes:
        if part.size_bytes > size_bytes:
            part.restart()
        raise _TransferError(f"{_host(url)} broke off after {part.size_bytes:,} of {size_bytes:,} bytes")


def _request(url: str, origin: RemoteVersion | None, part: PartialFile, retry: RetryPolicy) -> http.client.HTTPResponse:
    """Send the request; return the response, its body unread."""
    headers = {"User-Agent": "sigmasplat", "Accept-Encoding": "identity"}
    if origin and part.size_bytes:
        headers["Range"] = f"bytes={part.size_bytes}-"
        if origin.version:
            headers["If-Range"] = origin.version
    request = urllib.request.Request(url, headers=headers)
    try:
        opener = urllib.request.build_opener(_SafeRedirect())
        response: http.client.HTTPResponse = opener.open(request, timeout=retry.timeout_s)
        return response
    except urllib.error.HTTPError as refusal:
        with refusal:
            raise _http_error(url, refusal, part) from refusal
    except urllib.error.URLError as problem:
        raise _connection_error(url, problem.reason) from problem
    except (OSError, http.client.HTTPException) as problem:
        raise _TransferError(f"{_host(url)} does not answer properly ({problem!r})") from problem


def _http_error(url: str, refusal: urllib.error.HTTPError, part: PartialFile) -> Exception:
    why = f"HTTP {refusal.code} {refusal.reason}".rstrip()
    if refusal.code == RANGE_NOT_SATISFIABLE and part.size_bytes:
        part.restart()
        return _TransferError(f"{url}: {why}")
    if refusal.code in RETRIED_CODES:
        after = refusal.headers.get("Retry-After", "")
        return _TransferError(
            f"{_host(url)} is busy or out of order ({why}); try later", float(after) if after.isdigit() else 0
        )
    return DownloadError(f"{url} cannot be had ({why}); it may have moved or want a login")


def _connection_error(url: str, reason: object) -> Exception:
    host = _host(url)
    if isinstance(reason, ssl.SSLCertVerificationError):
        return DownloadError(f"the certificate of {host} is not trusted ({reason.verify_message}); check the clock")
    if isinstance(reason, socket.gaierror):
        return _TransferError(f"cannot find {host} ({reason.strerror}); is this machine online?", hopeless=True)
    if isinstance(reason, TimeoutError):
        why = f"{host} does not answer; is this machine online, does it need a proxy (https_proxy)?"
        return _TransferError(why, hopeless=True)
    return _TransferError(f"cannot connect to {host} ({reason}); is this machine online?", hopeless=True)


def _prepare(
    url: str, response: http.client.HTTPResponse, part: PartialFile, origin: RemoteVersion | None
) -> int | None:
    """Make `part` ready for the body to come; return the size of the whole file, None where the server names none."""
    headers = response.headers
    if headers.get_content_type() == "text/html":
        raise DownloadError(f"{_host(url)} answers with a web page, not the file; is there a login page in between?")
    if response.status == http.client.PARTIAL_CONTENT and origin and part.size_bytes:
        start, size_bytes = _content_range(headers.get("Content-Range", ""))
        if start == part.size_bytes and size_bytes in (None, origin.size_bytes):
            return origin.size_bytes
        part.restart()
        raise _TransferError(f"{_host(url)} answered with another part of the file than was asked for")
    part.restart()
    length = headers.get("Content-Length", "")
    if not length.isdigit() and not response.chunked:  # the end could not be told from a broken connection
        raise DownloadError(f"{_host(url)} does not say how long the file is, so it could not be known to be whole")
    size_bytes = int(length) if length.isdigit() else None
    part.begin(RemoteVersion(url, _version(headers), size_bytes))
    return size_bytes


def _version(headers: Message) -> str:
    """Return what may stand in If-Range: a strong ETag, or the date."""
    etag = str(headers.get("ETag", ""))
    return etag if etag.startswith('"') else str(headers.get("Last-Modified", ""))


def _content_range(value: str) -> tuple[int, int | None]:
    """Read "bytes 10-99/100": the first byte and the size of the whole; (-1, None) if it says something else."""
    unit, _, rest = value.partition(" ")
    span, _, size = rest.partition("/")
    start = span.partition("-")[0]
    if unit != "bytes" or not start.isdigit():
        return -1, None
    return int(start), int(size) if size.isdigit() else None


def _receive(
    response: http.client.HTTPResponse,
    part: PartialFile,
    size_bytes: int | None,
    progress: "Progress",
    retry: RetryPolicy,
) -> None:
    """Write the body as it comes. Raises _Broken if the connection fails or hardly anything comes."""
    host = response.geturl()
    since_s, since_bytes = time.monotonic(), part.size_bytes
    while True:
        try:
            chunk = response.read1(CHUNK_BYTES)
        except (OSError, http.client.HTTPException) as problem:
            raise _TransferError(f"the connection to {_host(host)} broke ({problem!r})") from problem
        if not chunk:
            return
        part.add(chunk)
        progress(part.size_bytes, size_bytes or 0)
        passed_s = time.monotonic() - since_s
        if passed_s >= retry.timeout_s:
            if part.size_bytes - since_bytes < retry.min_bytes_per_s * passed_s:
                raise _TransferError(f"hardly anything comes from {_host(host)}")
            since_s, since_bytes = time.monotonic(), part.size_bytes


class _SafeRedirect(urllib.request.HTTPRedirectHandler):
    """Follow redirects, but not from https to something that anybody on the way could change."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        """Return the request to follow. Raises DownloadError if its address is less safe."""
        if urlsplit(newurl).scheme not in {"https", urlsplit(req.full_url).scheme}:
            raise DownloadError(f"{_host(req.full_url)} sends on to {newurl}, which is not https; not followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _host(url: str) -> str:
    return urlsplit(url).hostname or url
