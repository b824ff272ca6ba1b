"""The viewer in this process, without a browser: a client is connected, and the controls follow what is shown."""

import importlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from room_map import room_map
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd

viser = pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from sigmasplat.plugins.viewer.app import ViewerApp  # noqa: E402
from sigmasplat.plugins.viewer.layers import MODES, PREDICTED_MODES  # noqa: E402
from sigmasplat.plugins.viewer.server import HOST, close, open_server  # noqa: E402
from sigmasplat.plugins.viewer.snapshot import EMPTY_PATH, Piece, Snapshot  # noqa: E402
from sigmasplat.plugins.viewer.snapshot_sources import LiveView  # noqa: E402

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
viewer_memory = importlib.import_module("viewer_memory")
FRAMES = 30


def wait_until(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 20.0
    while not true():
        assert time.monotonic() < end_s, "the viewer did not show it"
        time.sleep(0.02)


def look_from_the_origin(url: str, stop: threading.Event, received: list[int]) -> None:
    """Connect as a browser does, with a small window, and count the bytes of each message."""
    msgspec = importlib.import_module("msgspec")
    from websockets.sync.client import connect

    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -1.0), "fov": 1.0,
        "near": 0.01, "far": 1000.0, "image_height": 48, "image_width": 64, "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, -1.0, 0.0),
    }  # fmt: skip
    with connect(url, max_size=None, subprotocols=[f"viser-v{viser.__version__}"]) as socket:
        socket.send(msgspec.msgpack.encode(camera))
        while not stop.is_set():
            with suppress(TimeoutError):
                received.append(len(socket.recv(timeout=0.1)))


@pytest.fixture
def app() -> Iterator[ViewerApp]:
    server = open_server(HOST, 0, "test")
    app = ViewerApp(server)
    yield app
    app.stop()
    close(server)


@pytest.fixture
def client(app: ViewerApp) -> Iterator[list[int]]:
    stop, received = threading.Event(), list[int]()
    url = f"ws://{HOST}:{app.server.get_port()}"
    thread = threading.Thread(target=look_from_the_origin, args=(url, stop, received))
    thread.start()
    wait_until(lambda: bool(app.server.get_clients()))
    yield received
    stop.set()
    thread.join()


def test_a_growing_run_is_shown_and_the_controls_follow(
    app: ViewerApp, client: list[int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    growing: Any = viewer_memory.Growing(tmp_path / "submaps", 300)
    live = LiveView(growing.slam, app.show, "a growing run", every_s=0.0, clock=lambda: 1.0)
    for _ in range(FRAMES):
        live(growing())
    panel = app.panel
    # the timeline stays at its end: the viewer's thread moves it after its end has moved
    wait_until(lambda: panel.row.max == panel.row.value == FRAMES - 1 and "growing" in panel.facts.content)
    assert not panel.legend.visible, "the splats' own colours need no legend"

    panel.colouring.value = "uncertainty"
    wait_until(lambda: panel.legend.visible)
    texts = panel.hidden_text.content
    panel.hidden.value = 50
    wait_until(lambda: panel.hidden_text.content != texts)
    offered = [mode for mode in MODES if MODES[mode] in panel.mode.options]
    assert set(MODES) - set(offered) == {*PREDICTED_MODES}, "submaps have no predicted errors"
    assert not panel.keyframes.value, "the viewer opens without frusta"
    for mode in (*offered[1:], offered[0]):
        before = len(client)
        panel.mode.value = MODES[mode]
        wait_until(lambda before=before: len(client) > before)  # type: ignore[misc]
    panel.row.value = 3
    wait_until(lambda: "3" in panel.frame.content)
    for control in (panel.keyframes, panel.path):
        before = len(client)
        control.value = not control.value
        wait_until(lambda before=before: len(client) > before)  # type: ignore[misc]
    assert "viewer:" not in capsys.readouterr().err, "no error while drawing"


def test_predicted_errors_are_offered_for_the_final_map_only(
    app: ViewerApp, client: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """The errors have a legend, and hiding the most uncertain ones hides the splats with the larger error."""
    field, panel = room_map(), app.panel
    half = torch.arange(len(field)) % 2 == 0
    variances = torch.where(half[:, None], torch.tensor([0.01, 1e-4, 1e-4]), torch.tensor([0.01, 0.04, 0.04]))
    std = SplatStd(torch.where(half, 0.01, 0.2), torch.full((len(field),), 0.1))
    known = MapUncertainty(variances, Background((0.5, 0.5, 0.5), 0.1, 1.0), SHIPPED, 4, std)
    app.show(Snapshot("room", EMPTY_PATH, Piece(None, field, uncertainty=known)))
    offered = lambda: {MODES[mode] for mode in PREDICTED_MODES} <= {*panel.mode.options}  # noqa: E731
    wait_until(offered)
    everything = panel.facts.content
    panel.hidden.value = 60
    wait_until(lambda: "error of depth above" in panel.hidden_text.content and " m" in panel.hidden_text.content)
    assert panel.facts.content != everything and f"{int(half.sum()):,} of {len(field):,}" in panel.facts.content
    for mode in PREDICTED_MODES:
        before = len(client)
        panel.mode.value = MODES[mode]
        wait_until(lambda before=before: len(client) > before)  # type: ignore[misc]
    wait_until(lambda: panel.legend.visible)
    app.show(Snapshot("room", EMPTY_PATH, None, (Piece(0, field),)))
    wait_until(lambda: not offered())
    assert panel.mode.value == MODES["splats"] and "viewer:" not in capsys.readouterr().err, "no error while drawing"
