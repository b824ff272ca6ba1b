"""Other pages in the same browser cannot reach the viewer, neither by its address nor by a name that points to it."""

import http.client
import socket
from collections.abc import Iterator

import pytest

from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.viewer.server import HOST, close, is_own_page, open_server

HERE = "127.0.0.1:8080"


def test_only_pages_of_the_same_address_belong_to_the_viewer() -> None:
    for origin, reached, own in [
        (None, HERE, True),  # not a browser
        ("http://127.0.0.1:8080", HERE, True),
        ("http://localhost:9000", "localhost:9000", True),  # ssh -L 9000:127.0.0.1:8080
        ("http://[::1]:8080", "[::1]:8080", True),
        ("http://192.168.1.5", "192.168.1.5", True),
        ("https://BOX.lan", "box.lan", True),
        (f"http://{socket.gethostname()}:8080", f"{socket.gethostname()}:8080", True),
        ("https://evil.example", HERE, False),
        ("http://127.0.0.1:8888", HERE, False),  # another server on this machine
        ("http://localhost:8080", HERE, False),
        ("http://evil.example:8080", "evil.example:8080", False),  # a foreign name that points to this machine
        ("http://box.lan.evil.example", "box.lan.evil.example", False),
        ("null", HERE, False),  # a file, a sandboxed frame
        ("", HERE, False),
        ("http://[::1", "[::1", False),
        ("file://127.0.0.1:8080", HERE, False),
        ("http://127.0.0.1:8080", None, False),
    ]:
        assert is_own_page(origin, reached, "box.lan") is own


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
    server = open_server(HOST, 0, "test")
    yield server.get_port()
    close(server)


def test_a_websocket_from_another_page_is_refused(port: int) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect
    from websockets.typing import Origin

    for origin in (None, Origin(f"http://{HOST}:{port}")):
        with connect(f"ws://{HOST}:{port}", origin=origin, proxy=None) as socket:
            assert socket.response is not None and socket.response.status_code == 101
    for other in ("https://evil.example", f"http://localhost:{port}", "null"):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://{HOST}:{port}", origin=Origin(other), proxy=None)
        assert refused.value.response.status_code == 403


def test_the_viewers_own_page_is_served(port: int) -> None:
    connection = http.client.HTTPConnection(HOST, port)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()


def test_other_websocket_servers_are_not_changed(port: int) -> None:
    from websockets.asyncio import server

    assert server.serve.__module__ == "websockets.asyncio.server" and isinstance(server.serve, type)


def test_a_viser_version_that_cannot_be_restricted_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
    stopped = []

    class Otherwise:
        def __init__(self, **_: object) -> None: ...

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Otherwise)
    with pytest.raises(SigmaSplatError, match=r"any page open in the browser; install viser==1\.1\.1"):
        open_server(HOST, 0, "test")
    assert len(stopped) == 1
