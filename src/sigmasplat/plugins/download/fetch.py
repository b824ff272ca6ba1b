"""Fetch a file over HTTP, with resume and retries; the file gets its final name only when it is complete.

NAME.part        the bytes downloaded so far
NAME.part.json   {"url", "version", "size_bytes"} of the remote file
"""

import fcntl
import http.client
import json
import os
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from sigmasplat.api import DownloadError

if TYPE_CHECKING:
    from sigmasplat.api import Progress


@dataclass(frozen=True)
class RemoteVersion:
    """A version of a remote file; version: its ETag or date, "" if the server sends neither."""

    url: str
    version: str
    size_bytes: int | None


class PartialFile:
    """The downloaded part of `target`, open for writing and locked against other processes."""

    def __init__(self, target: Path, file: FileIO) -> None:
        self.target, self._file = target, file
        self._note = _note_path(target)

    @property
    def size_bytes(self) -> int:
        """Return the number of bytes downloaded so far."""
        return self._file.tell()

    def version_of(self, url: str) -> RemoteVersion | None:
        """Return the version of the bytes so far; if it is unknown or not of `url`, delete them and return None."""
        try:
            version = RemoteVersion(**json.loads(self._note.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            version = None
        too_many = version and version.size_bytes is not None and self.size_bytes > version.size_bytes
        if version is None or version.url != url or too_many:
            self.restart()
            return None
        return version

    def restart(self) -> None:
        """Delete the bytes so far."""
        self._note.unlink(missing_ok=True)
        self._file.seek(0)
        self._file.truncate()

    def begin(self, version: RemoteVersion) -> None:
        """Record the version of the following bytes."""
        with _writing(self.target):
            self._note.write_text(json.dumps(asdict(version)), encoding="utf-8")

    def add(self, chunk: bytes) -> None:
        """Write a chunk. Raises DownloadError if the disk is full."""
        rest = memoryview(chunk)
        with _writing(self.target):
            while rest:
                rest = rest[_write_some(self._file, rest) :]

    def finish(self) -> None:
        """Rename the complete file to its final name."""
        with _writing(self.target):
            self._file.flush()
            os.fsync(self._file.fileno())
            os.replace(self._file.name, self.target)
        self._note.unlink(missing_ok=True)


@contextmanager
def open_partial(target: Path) -> Iterator[PartialFile]:
    """Open the existing part of `target`, or an empty one. Raises DownloadError if another process writes it."""
    with _writing(target):
        file = target.with_name(f"{target.name}.part").open("ab", buffering=0)
    with file:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as problem:
                raise DownloadError(f"{file.name} is being downloaded by another process; wait for it") from problem
        try:
            yield PartialFile(target, file)
        finally:
            if not file.tell():
                Path(file.name).unlink(missing_ok=True)
                _note_path(target).unlink(missing_ok=True)


def _write_some(file: FileIO, chunk: memoryview) -> int:
    """Write as much of a chunk as one call accepts; return the number of bytes."""
    return file.write(chunk)


def _note_path(target: Path) -> Path:
    return target.with_name(f"{target.name}.part.json")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert OSError to DownloadError."""
    try:
        yield
    except OSError as problem:
        raise DownloadError(
            f"cannot write {path}: {problem.strerror or problem}; the part downloaded so far is kept"
        ) from problem


CHUNK_BYTES = 2**18
RETRIED_CODES = {408, 425, 429, 500, 502, 503, 504}
RANGE_NOT_SATISFIABLE = 416
CheckSize = Callable[[int | None, int], None]
"""Called with the size from the server (None: unknown) and the bytes already here; raises to refuse the download."""


@dataclass(frozen=True)
class RetryPolicy:
    """How long to wait for the server, and how often to retry.

    timeout_s: limit on the time without an answer, or with fewer than `min_bytes_per_s`; max_attempts: limit on
    consecutive attempts that gain less than `progress_bytes`; first_wait_s: wait before a retry, doubled up to
    max_wait_s.
    """

    timeout_s: float = 30.0
    min_bytes_per_s: float = 500.0
    max_attempts: int = 6
    progress_bytes: int = 2**20
    first_wait_s: float = 1.0
    max_wait_s: float = 30.0


class _TransferError(Exception):
    """A failed attempt that can be retried. hopeless: do not retry before any byte has arrived (no network, no such
    host)."""

    def __init__(self, why: str, wait_s: float = 0.0, hopeless: bool = False) -> None:
        super().__init__(why)
        self.wait_s, self.hopeless = wait_s, hopeless


def fetch(url: str, target: Path, progress: "Progress", check_size: CheckSize, retry: RetryPolicy) -> None:
    """Download `url` to `target`; resume from `target`.part if an earlier call left one.

    The part downloaded so far is kept on Ctrl-C and on every error. Raises DownloadError.
    """
    with open_partial(target) as part:
        failures = 0
        while True:
            before = part.size_bytes
            try:
                _continue(url, part, progress, check_size, retry)
                break
            except _TransferError as broken:
                gained = part.size_bytes - before
                failures = 0 if gained >= retry.progress_bytes else failures + 1
                if failures >= retry.max_attempts or (broken.hopeless and not part.size_bytes):
                    kept = f"; {part.size_bytes:,} bytes are kept, run it again to resume" if part.size_bytes else ""
                    raise DownloadError(f"{broken}{kept}") from broken
                waited_s = retry.first_wait_s * 2.0 ** max(failures - 1, 0)
                time.sleep(min(max(waited_s, broken.wait_s), retry.max_wait_s))
        part.finish()


def _continue(url: str, part: PartialFile, progress: "Progress", check_size: CheckSize, retry: RetryPolicy) -> None:
    """Request the missing bytes and write them. Raises _Broken if not all of it comes."""
    version = part.version_of(url)
    if version and version.size_bytes == part.size_bytes:
        return
    with _request(url, version, part, retry) as response:
        size_bytes = _prepare(url, response, part, version)
        check_size(size_bytes, part.size_bytes)
        _receive(response, part, size_bytes, progress, retry)
    if size_bytes is not None and part.size_bytes != size_bytes:
        if part.size_bytes > size_bytes:
            part.restart()
        raise _TransferError(f"{_host(url)} closed the connection after {part.size_bytes:,} of {size_bytes:,} bytes")


def _request(
    url: str, version: RemoteVersion | None, part: PartialFile, retry: RetryPolicy
) -> http.client.HTTPResponse:
    """Send the request; return the response before its body is read."""
    headers = {"User-Agent": "sigmasplat", "Accept-Encoding": "identity"}
    if version and part.size_bytes:
        headers["Range"] = f"bytes={part.size_bytes}-"
        if version.version:
            headers["If-Range"] = version.version
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
            f"{_host(url)} is busy or out of service ({why}); try later", float(after) if after.isdigit() else 0
        )
    return DownloadError(f"{url} is not available ({why}); it may have moved or require a login")


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
    url: str, response: http.client.HTTPResponse, part: PartialFile, version: RemoteVersion | None
) -> int | None:
    """Prepare `part` for the body; return the size of the whole file, None if the server does not send it."""
    headers = response.headers
    if headers.get_content_type() == "text/html":
        raise DownloadError(f"{_host(url)} answers with a web page, not the file; is there a login page in between?")
    if response.status == http.client.PARTIAL_CONTENT and version and part.size_bytes:
        start, size_bytes = _content_range(headers.get("Content-Range", ""))
        if start == part.size_bytes and size_bytes in (None, version.size_bytes):
            return version.size_bytes
        part.restart()
        raise _TransferError(f"{_host(url)} sent another part of the file than requested")
    part.restart()
    length = headers.get("Content-Length", "")
    if not length.isdigit() and not response.chunked:  # the end would look like a broken connection
        raise DownloadError(
            f"{_host(url)} does not send the length of the file, so a complete download could not be recognised"
        )
    size_bytes = int(length) if length.isdigit() else None
    etag = str(headers.get("ETag", ""))  # If-Range takes a strong one, or the date
    version_now = etag if etag.startswith('"') else str(headers.get("Last-Modified", ""))
    part.begin(RemoteVersion(url, version_now, size_bytes))
    return size_bytes


def _content_range(value: str) -> tuple[int, int | None]:
    """Parse "bytes 10-99/100": first byte and total size; (-1, None) for any other format."""
    unit, _, rest = value.partition(" ")
    span, _, size = rest.partition("/")
    start = span.partition("-")[0]
    if unit != "bytes" or not start.isdigit():
        return -1, None
    return int(start), int(size) if size.isdigit() else None


def _receive(
    response: http.client.HTTPResponse, part: PartialFile, size_bytes: int | None, progress: "Progress",
    retry: RetryPolicy,
) -> None:  # fmt: skip
    """Write the body as it arrives. Raises _TransferError if the connection fails or is too slow."""
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
                raise _TransferError(f"{_host(host)} sends too slowly")
            since_s, since_bytes = time.monotonic(), part.size_bytes


class _SafeRedirect(urllib.request.HTTPRedirectHandler):
    """Follow redirects, but not from https to an address without encryption."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        """Return the redirected request. Raises DownloadError if it leaves https."""
        if urlsplit(newurl).scheme not in {"https", urlsplit(req.full_url).scheme}:
            raise DownloadError(f"{_host(req.full_url)} redirects to {newurl}, which is not https; not followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _host(url: str) -> str:
    return urlsplit(url).hostname or url
