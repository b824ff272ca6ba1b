"""Fetch a file over HTTP, with resume and retries; the file gets its final name only when it is complete.

NAME.part contains the bytes downloaded so far. Parts of two versions of a file can be joined only if the file changes
during a download; the checks of the archive find that.
"""

import http.client
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING
from urllib.parse import urlsplit

from sigmasplat.api import DownloadError, guarded

if TYPE_CHECKING:
    from sigmasplat.api import Progress

CHUNK_BYTES = 2**18
TIMEOUT_S = 30.0
"""Longest time without an answer."""
ATTEMPTS, GAIN_BYTES = 6, 2**20
"""Give up after this many consecutive attempts that gain less than `GAIN_BYTES`."""
WAIT_S, MOST_WAIT_S = 1.0, 30.0
"""Wait before the first retry, doubled at each further one."""
RANGE_NOT_SATISFIABLE = 416
RETRIED_CODES = {408, RANGE_NOT_SATISFIABLE, 425, 429, 500, 502, 503, 504}
CheckSize = Callable[[int | None, int], None]
"""Called with the size from the server (None: unknown) and the bytes already here; raises to refuse the download."""


class _Broken(Exception):
    """An attempt failed, and another one may succeed."""


def fetch(url: str, target: Path, progress: "Progress", check_size: CheckSize) -> None:
    """Download `url` to `target`; resume from `target`.part if an earlier call left one.

    The part downloaded so far is kept on Ctrl-C and on every error. Raises DownloadError.
    """
    part, failures = target.with_name(f"{target.name}.part"), 0
    kept = "the part downloaded so far is kept"
    with guarded(target, kept, DownloadError, "cannot be written"), part.open("ab") as file:
        try:
            while True:
                before = file.tell()
                try:
                    _continue(url, file, progress, check_size)
                    break
                except _Broken as broken:
                    failures = 0 if file.tell() - before >= GAIN_BYTES else failures + 1
                    if failures >= ATTEMPTS:
                        kept = f"; {file.tell():,} bytes are kept, run it again to resume" if file.tell() else ""
                        raise DownloadError(f"{broken}{kept}") from broken
                    time.sleep(min(WAIT_S * 2.0 ** max(failures - 1, 0), MOST_WAIT_S))
            file.flush()
            os.fsync(file.fileno())
            part.rename(target)
        finally:
            if not file.tell():
                part.unlink(missing_ok=True)


def _continue(url: str, file: IO[bytes], progress: "Progress", check_size: CheckSize) -> None:
    """Request the missing bytes and write them. Raises _Broken if not all of them come."""
    host, done, total = urlsplit(url).hostname, file.tell(), None
    with _requested(url, file) as response:
        headers = response.headers
        if headers.get_content_type() == "text/html":
            raise DownloadError(f"{host} answers with a web page, not the file; is there a login page in between?")
        length = headers.get("Content-Length", "")
        if not length.isdigit() and not response.chunked:  # the end would look like a broken connection
            raise DownloadError(f"{host} does not send the length of the file, so its end could not be recognised")
        if response.status != http.client.PARTIAL_CONTENT:
            file.truncate(file.seek(0))
        elif not str(headers.get("Content-Range", "")).startswith(f"bytes {done}-"):
            file.truncate(file.seek(0))
            raise _Broken(f"{host} sent another part of the file than requested")
        total = file.tell() + int(length) if length.isdigit() else None
        check_size(total, file.tell())
        while chunk := _received(response):
            file.write(chunk)
            progress(file.tell(), total or 0)
    if total is not None and file.tell() != total:
        raise _Broken(f"{host} closed the connection after {file.tell():,} of {total:,} bytes")


def _requested(url: str, file: IO[bytes]) -> http.client.HTTPResponse:
    """Request what the file lacks. Return the response before its body is read."""
    host, done = urlsplit(url).hostname, file.tell()
    headers = {"User-Agent": "sigmasplat", "Accept-Encoding": "identity"}
    if done:
        headers["Range"] = f"bytes={done}-"
    try:
        response: http.client.HTTPResponse = urllib.request.urlopen(
            urllib.request.Request(url, headers=headers), timeout=TIMEOUT_S
        )
    except urllib.error.HTTPError as refusal:
        why = f"HTTP {refusal.code} {refusal.reason}".rstrip()
        if refusal.code == RANGE_NOT_SATISFIABLE:
            file.truncate(file.seek(0))
        if refusal.code in RETRIED_CODES:
            raise _Broken(f"{host} is busy or out of service ({why}); try later") from refusal
        raise DownloadError(f"{url} is not available ({why}); it may have moved or require a login") from refusal
    except urllib.error.URLError as problem:
        reason = getattr(problem.reason, "strerror", None) or problem.reason
        kind = _Broken if done else DownloadError  # an unreachable server is not asked again
        raise kind(
            f"cannot reach {host} ({reason}); is this machine online, does it need a proxy (https_proxy)?"
        ) from problem
    except (OSError, http.client.HTTPException) as problem:
        raise _Broken(f"{host} does not answer properly ({problem!r})") from problem
    if url.startswith("https:") and not response.geturl().startswith("https:"):
        raise DownloadError(f"{host} redirects to {response.geturl()}, which is not https; not followed")
    return response


def _received(response: http.client.HTTPResponse) -> bytes:
    """Return what has arrived of the body, b"" at its end. Raises _Broken if the connection fails."""
    try:
        return response.read1(CHUNK_BYTES)
    except (OSError, http.client.HTTPException) as problem:
        raise _Broken(f"the connection to {urlsplit(response.geturl()).hostname} broke ({problem!r})") from problem
