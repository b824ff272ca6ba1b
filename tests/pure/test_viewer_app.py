"""The viewer in this process, without a browser: a client is connected, and the controls follow what is shown."""

import importlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from room_map import poses, room, room_map
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd

viser = pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from sigmasplat.plugins.viewer.app import ViewerApp  # noqa: E402
from sigmasplat.plugins.viewer.layers import MODES, PREDICTED_MODES  # noqa: E402
from sigmasplat.plugins.viewer.server import HOST, close, open_server  # noqa: E402
from sigmasplat.plugins.viewer.snapshot import EMPTY_PATH, Opening, Piece, Snapshot  # noqa: E402
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

    assert not panel.floating.visible and not panel.floating.value, "a live run stays where it is"
    panel.colouring.value = "how unsure"
    wait_until(lambda: panel.legend.visible)
    assert not panel.unsure.visible, "submaps have no measured errors"
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
    """The errors have a legend, and what is uncertain is shown only on request."""
    field, panel = room_map(), app.panel
    half = torch.arange(len(field)) % 2 == 0
    variances = torch.where(half[:, None], torch.tensor([0.01, 1e-4, 1e-4]), torch.tensor([0.01, 0.04, 0.04]))
    std = SplatStd(torch.where(half, 0.01, 0.2), torch.full((len(field),), 0.1))
    known = MapUncertainty(variances, Background((0.5, 0.5, 0.5), 0.1, 1.0), SHIPPED, 4, std)
    app.show(Snapshot("room", EMPTY_PATH, Piece(None, field, uncertainty=known, sure=half)))
    offered = lambda: {MODES[mode] for mode in PREDICTED_MODES} <= {*panel.mode.options}  # noqa: E731
    wait_until(offered)
    wait_until(lambda: f"{int(half.sum()):,} of {len(field):,} splats" in panel.facts.content and panel.unsure.visible)
    panel.unsure.value = True
    wait_until(lambda: f"{len(field):,} of {len(field):,} splats" in panel.facts.content)
    for mode in PREDICTED_MODES:
        before = len(client)
        panel.mode.value = MODES[mode]
        wait_until(lambda before=before: len(client) > before)  # type: ignore[misc]
    wait_until(lambda: panel.legend.visible)
    app.show(Snapshot("room", EMPTY_PATH, None, (Piece(0, field),)))
    wait_until(lambda: not offered() and panel.mode.value == MODES["splats"])
    assert "viewer:" not in capsys.readouterr().err, "no error while drawing"


def turned(client: Any, opening: Opening) -> float:
    """Return the angle in degrees between a browser's camera and the opening, seen from what it looks at."""
    at = opening.T_world_camera @ np.array([0.0, 0.0, opening.ahead_m, 1.0])
    away, start = client.camera.position - at[:3], opening.T_world_camera[:3, 3] - at[:3]
    return float(np.degrees(np.arccos(np.clip(away @ start / np.linalg.norm(away) / np.linalg.norm(start), -1.0, 1.0))))


def test_a_browser_opens_at_the_best_view_and_floats_until_a_person_moves_it(app: ViewerApp, client: list[int]) -> None:
    opening = Opening(poses()[1], 2.0, Camera(40, 40, 50.0, 50.0, 19.5, 19.5), np.array([0.0, -1.0, 0.0]))
    app.show(Snapshot("room", EMPTY_PATH, Piece(None, room_map()), opening=opening))
    (page,) = app.server.get_clients().values()
    wait_until(lambda: bool(np.allclose(page.camera.position, opening.T_world_camera[:3, 3], atol=1e-6)))
    wide = 2.0 * np.arctan(0.5 * 48 / 64 / 50.0 * 40)  # the window is 64×48: the whole width of the image
    assert page.camera.fov == pytest.approx(wide) and opening.fov(0.25) > opening.fov(1.0)
    np.testing.assert_allclose(app.server.initial_camera.position, opening.T_world_camera[:3, 3])
    wait_until(lambda: turned(page, opening) > 0.3)
    assert not app.panel.path.value, "nothing is drawn over the first look"
    assert app.panel.floating.value and turned(page, opening) < 2.1
    before = page.camera.position
    page.camera.position = before + 0.2
    wait_until(lambda: not app.panel.floating.value)
    np.testing.assert_allclose(page.camera.position, before + 0.2)


def test_the_ruler_measures_between_two_clicked_points(app: ViewerApp) -> None:
    frame, T = room().frame(0), poses()[0]
    rays, depth_m = room().camera.rays(), frame.depth_m
    points = (rays * depth_m[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    field = GaussianField.from_values(
        torch.tensor(points, dtype=torch.float32),
        torch.tensor(depth_m.reshape(-1, 1) / room().camera.fx, dtype=torch.float32).expand(-1, 3).contiguous(),
        torch.full((len(points), 3), 0.5),
        opacities=0.99,
    )
    app.show(Snapshot("room", EMPTY_PATH, Piece(None, field)))
    rows = [(20, 10), (60, 80)]
    app.ruler.start()
    assert app.panel.length.content == "click the first point"
    for click, (row, column) in enumerate(rows):
        direction = T[:3, :3] @ rays[row, column]
        app.ruler.clicked(SimpleNamespace(ray_origin=tuple(T[:3, 3]), ray_direction=tuple(direction)))
        assert click or app.panel.length.content == "click the second point"
    ends = [T[:3, :3] @ (rays[at] * depth_m[at]) for at in rows]
    length_m = float(app.panel.length.content.split(" m")[0])
    assert length_m == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.02)
    app.ruler.start()
    app.ruler.clicked(SimpleNamespace(ray_origin=(0.0, 0.0, 0.0), ray_direction=(0.0, 0.0, -1.0)))
    assert app.panel.length.content == "no surface there: click another point"
