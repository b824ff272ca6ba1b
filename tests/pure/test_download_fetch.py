"""For every behaviour of the server, the file is complete or absent, and no byte is requested twice."""

import resource
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

import file_server as acts
from file_server import Act, FileServer, serving
from sigmasplat.errors import DownloadError
from sigmasplat.plugins.download import fetch as fetching
from sigmasplat.plugins.download.fetch import fetch

BODY = bytes(range(256)) * 40


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    for name, value in {"ATTEMPTS": 3, "GAIN_BYTES": 1000, "WAIT_S": 0.001, "TIMEOUT_S": 0.5}.items():
        monkeypatch.setattr(fetching, name, value)
    with serving() as server:
        server.files["/a.tgz"] = BODY
        yield server


def fetched(server: FileServer, target: Path) -> list[tuple[int, int]]:
    """Fetch /a.tgz; return the calls of progress."""
    calls: list[tuple[int, int]] = []
    fetch(server.url("/a.tgz"), target, lambda *counts: calls.append(counts), lambda *sizes: None)
    return calls


def left_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_is_downloaded_completely(server: FileServer, tmp_path: Path) -> None:
    calls = fetched(server, tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == BODY
    assert left_in(tmp_path) == {"a.tgz"}
    assert calls[-1] == (len(BODY), len(BODY)) and calls == sorted(calls)


@pytest.mark.parametrize(
    "first",
    [
        [acts.drop_after(3000)],
        [acts.drop_after(3000), acts.drop_after(2000), acts.drop_after(1), acts.drop_after(0)],
        [acts.drop_after(3000), acts.without_ranges],
        [acts.drop_after(3000), acts.wrong_range],
        [acts.drop_after(3000), acts.status(416)],
        [acts.status(503), acts.status(500, Retry_After=0)],
        [acts.says_length(+50)],
        [acts.chunked(broken=True)],
        [acts.chunked(broken=True), acts.chunked(broken=False)],
        [acts.drop_after(5000), acts.status(302, Location="/moved.tgz")],
    ],
    ids=lambda first: str(len(first)),
)
def test_the_file_is_complete_after_failures(first: list[Act], server: FileServer, tmp_path: Path) -> None:
    server.acts = list(first)
    server.files["/moved.tgz"] = BODY
    fetched(server, tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == BODY
    assert left_in(tmp_path) == {"a.tgz"}


def test_the_file_is_complete_after_a_silent_attempt(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.drop_after(3000), acts.silence(0.8)]
    fetched(server, tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == BODY
    assert server.ranges == ["", "bytes=3000-", "bytes=3000-"]


def test_a_download_resumes_after_a_break(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.drop_after(3000), acts.drop_after(2500)]
    fetched(server, tmp_path / "a.tgz")
    assert server.ranges == ["", "bytes=3000-", "bytes=5500-"]


def test_a_later_call_resumes(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.drop_after(3000), acts.status(503), acts.status(503), acts.status(503)]
    with pytest.raises(DownloadError, match=r"3,000 bytes are kept"):
        fetched(server, tmp_path / "a.tgz")
    assert not (tmp_path / "a.tgz").exists()
    calls = fetched(server, tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == BODY
    assert server.ranges[-1] == "bytes=3000-" and calls[0][0] > 3000


def test_ctrl_c_keeps_the_partial_file(server: FileServer, tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    server.acts = [acts.drop_after(4000)]
    with pytest.raises(KeyboardInterrupt):
        fetch(server.url("/a.tgz"), tmp_path / "a.tgz", interrupt, lambda *sizes: None)
    assert left_in(tmp_path) == {"a.tgz.part"}
    fetched(server, tmp_path / "a.tgz")
    assert (tmp_path / "a.tgz").read_bytes() == BODY
    assert server.ranges[-1].startswith("bytes=")


@pytest.mark.parametrize(
    ("answers", "says"),
    [
        (
            [acts.drop_after(500), acts.drop_after(0), acts.drop_after(0)],
            r"closed the connection after 500 of 10,240 bytes; 500 bytes are kept",
        ),
        ([acts.status(503)] * 3, r"busy or out of service \(HTTP 503 Service Unavailable\)"),
        ([acts.chunked(broken=True)] * 3, r"the connection to 127.0.0.1 broke \(IncompleteRead"),
    ],
    ids=["drops", "503", "chunks"],
)
def test_the_download_fails_after_the_last_retry(
    answers: list[Act], says: str, server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetching, "GAIN_BYTES", 2**20)
    server.acts = list(answers)
    with pytest.raises(DownloadError, match=says):
        fetched(server, tmp_path / "a.tgz")
    assert server.acts == [] and not (tmp_path / "a.tgz").exists()


def test_a_silent_server_is_an_error(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.silence(0.8)] * 3
    with pytest.raises(DownloadError, match=r"127.0.0.1 does not answer properly \(TimeoutError"):
        fetched(server, tmp_path / "a.tgz")


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (acts.status(404), r"/a.tgz is not available \(HTTP 404 Not Found\)"),
        (acts.status(403), r"HTTP 403 Forbidden"),
        (acts.web_page, r"answers with a web page"),
        (acts.endless, r"does not send the length of the file"),
        (acts.sends_on("ftp://127.0.0.1:1/a.tgz"), r"cannot reach 127.0.0.1"),
    ],
    ids=["404", "403", "html", "no length", "ftp"],
)
def test_some_errors_are_not_retried(act: Act, says: str, server: FileServer, tmp_path: Path) -> None:
    server.acts = [act]
    with pytest.raises(DownloadError, match=says):
        fetched(server, tmp_path / "a.tgz")
    assert len(server.ranges) == 1
    assert left_in(tmp_path) == set()


def test_a_size_can_be_refused_before_writing(server: FileServer, tmp_path: Path) -> None:
    def check_size(size_bytes: int | None, downloaded_bytes: int) -> None:
        assert (size_bytes, downloaded_bytes) == (len(BODY), 0)
        raise DownloadError("too large")

    with pytest.raises(DownloadError, match="too large"):
        fetch(server.url("/a.tgz"), tmp_path / "a.tgz", lambda *counts: None, check_size)
    assert not (tmp_path / "a.tgz.part").exists()


def test_a_redirect_from_https_stays_encrypted(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = urllib.request.urlopen(server.url("/a.tgz"))  # where a redirect has led
    monkeypatch.setattr(urllib.request, "urlopen", lambda *arguments, **options: opened)
    with pytest.raises(DownloadError, match=r"example.com redirects to http://127.*, which is not https"):
        fetch("https://example.com/a.tgz", tmp_path / "a.tgz", lambda *c: None, lambda *s: None)
    assert left_in(tmp_path) == set()


def test_a_full_disk_is_reported(server: FileServer, tmp_path: Path) -> None:
    """The system's limit on the size of a file stands for the disk: what fits is written, then writing fails."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        with pytest.raises(DownloadError, match="File too large"):
            fetched(server, tmp_path / "a.tgz")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not (tmp_path / "a.tgz").exists() and (tmp_path / "a.tgz.part").stat().st_size == 5000


def test_an_unreachable_server_is_reported(tmp_path: Path, server: FileServer) -> None:
    with pytest.raises(DownloadError, match=r"cannot reach 127.0.0.1 .*refused"):
        fetch("http://127.0.0.1:1/a.tgz", tmp_path / "a.tgz", lambda *c: None, lambda *s: None)
    assert left_in(tmp_path) == set()
