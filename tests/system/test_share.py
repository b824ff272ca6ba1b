"""A shared page in headless Chromium, opened from the disk: at the size of a desktop and of a phone."""

import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from command_line import exit_code
from headless_browser import CHROMIUM, Page, Pixels, chromium, keep, wait_for
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.render import render
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium)")

ROOM = SyntheticRoom(frames=120, width=96, height=72)
POSES = ROOM.truth().T_world_camera[[0, 6]]
STD_M = 0.01
BACKGROUND = np.array([16, 18, 20]) / 255.0
FLOATERS = 40
DESKTOP, PHONE = (1280, 800), (390, 844)


def surfaces() -> GaussianField:
    """Return every pixel of two frames as a small splat, and red floaters half way to what the first one sees."""
    points, sizes, colors = [], [], []
    for frame, T in zip((ROOM.frame(0), ROOM.frame(6)), POSES, strict=True):
        seen = frame.depth_m > 0
        points.append((ROOM.camera.rays() * frame.depth_m[..., None])[seen] @ T[:3, :3].T + T[:3, 3])
        sizes.append(frame.depth_m[seen] / ROOM.camera.fx * 0.7)
        colors.append(frame.color[seen])
    middle = (points[0][:: len(points[0]) // FLOATERS][:FLOATERS] + POSES[0][:3, 3]) / 2.0
    values = [np.concatenate(parts) for parts in (
        [middle, *points], [np.full(FLOATERS, 0.03), *sizes], [np.tile([1.0, 0.0, 0.0], (FLOATERS, 1)), *colors],
    )]  # fmt: skip
    return GaussianField.from_values(*(torch.tensor(part, dtype=torch.float32) for part in values), opacities=0.97)


@pytest.fixture(scope="module")
def field() -> GaussianField:
    return surfaces()


@pytest.fixture(scope="module")
def shared(field: GaussianField, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Share a run, made by hand, that holds the surfaces and is not sure about the floaters."""
    run = RunFolder.create(tmp_path_factory.mktemp("share") / "room <b>&", BASE, "room")
    run.note(camera=asdict(ROOM.camera))
    for i in range(2):
        run.log({"index": i, "timestamp_s": i / 10, "is_keyframe": True, "lost": False, "seconds": {}})
    run.write_trajectory(Trajectory(np.array([0.0, 0.1]), POSES))
    run.write_map(field)
    std_m = torch.full((len(field),), STD_M)
    std_m[:FLOATERS] = 1.0
    background = Background((0.5, 0.5, 0.5), 0.1, 0.1)
    known = MapUncertainty(torch.zeros(len(field), 3), background, SHIPPED, std=SplatStd(std_m, std_m))
    run.write_uncertainty(known)
    out = run.path.parent / "room.html"
    assert exit_code("share", str(run.path), "--out", str(out)) == 0
    return out


@pytest.fixture(params=[DESKTOP, PHONE], ids=["desktop", "phone"])
def page(request: pytest.FixtureRequest, shared: Path, tmp_path: Path) -> Iterator[Page]:
    """Open the page at the size of a desktop or of a phone, which is touched, without its floating at the start."""
    width, height = request.param
    with chromium("about:blank", tmp_path / "profile") as port:
        page = Page(port)
        for domain in ("Runtime", "Log", "Page"):
            page.call(f"{domain}.enable")
        phone = request.param == PHONE
        page.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone
        )  # fmt: skip
        page.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        page.call("Page.navigate", url=shared.as_uri())
        settle(page)
        yield page
        assert page.problems == []


def settle(page: Page) -> None:
    wait_for(lambda: page.value("sigmasplat.ready()") is True)


def press(page: Page, button: str) -> None:
    page.click(f"document.getElementById('{button}')")
    settle(page)


def tap(page: Page, x: float, y: float, time_s: float = 0.0) -> None:
    """Touch a place, at a time that a slow machine does not change; a desktop clicks it."""
    given = {"timestamp": time_s} if time_s else {}
    if page.value("navigator.maxTouchPoints > 0"):
        page.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}], **given)
        page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[], **given)
    else:
        for kind in ("mousePressed", "mouseReleased"):
            page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1, **given)


def T_page_world(page: Page) -> NDArray[np.float64]:
    """Return the transform of the run's world to the axes of the page: from the first keyframe in both."""
    return np.array(page.value("sigmasplat.scene.keyframes[0]")).reshape(4, 4) @ np.linalg.inv(POSES[0])


def rendered(page: Page, field: GaussianField) -> NDArray[np.float64]:
    """Render what SigmaSplat itself sees from the page's camera, before the page's background."""
    height, width, _ = page.screenshot().shape
    T = np.eye(4)
    T[:3, :3] = np.array(page.value("sigmasplat.axesOf(sigmasplat.cam)")).T
    T[:3, 3] = page.value("sigmasplat.cam.eye")
    focal = page.value("sigmasplat.cam.focal")
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    with torch.inference_mode():
        seen = render(field, camera, se3.inverse(np.linalg.inv(T_page_world(page)) @ T))
    return (seen.color + (1.0 - seen.alpha)[..., None] * torch.tensor(BACKGROUND)).clamp(0.0, 1.0).numpy()


def scene_alone(page: Page) -> Pixels:
    page.value("document.querySelectorAll('header, footer').forEach(e => { e.style.visibility = 'hidden' })")
    pixels = page.screenshot()
    page.value("document.querySelectorAll('header, footer').forEach(e => { e.style.visibility = '' })")
    return pixels


def psnr_db(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


def test_the_first_view_is_that_of_our_renderer_and_a_switch_adds_what_is_uncertain(
    page: Page, field: GaussianField
) -> None:
    sure = field.moved(torch.eye(4))
    sure.keep(torch.arange(len(field)) >= FLOATERS)
    keep(page.screenshot(), f"share-{page.screenshot().shape[1]}")
    first = scene_alone(page)
    # Scales in steps of 4 % and blending in bytes leave 40 dB; a wrong order, covariance or pose leaves less than 25.
    assert psnr_db(first / 255.0, rendered(page, sure)) > 34.0
    press(page, "uncertain")
    with_floaters = scene_alone(page)
    assert psnr_db(with_floaters / 255.0, rendered(page, field)) > 34.0
    red = (with_floaters[..., 0] > 200) & (with_floaters[..., 1] < 60)
    assert red.sum() > 200 and not ((first[..., 0] > 200) & (first[..., 1] < 60))[red].any()
    press(page, "uncertain")
    press(page, "colour")
    assert page.value("document.getElementById('legend').innerText").startswith("1.0 cm")
    assert np.abs(scene_alone(page).astype(int) - first).mean() > 20


def test_the_ruler_measures_between_two_taps_and_says_how_sure_it_is(page: Page) -> None:
    page.value("sigmasplat.setPose(sigmasplat.scene.keyframes[0])")
    settle(page)
    frame, T = ROOM.frame(0), T_page_world(page) @ POSES[0]
    points = (ROOM.camera.rays() * frame.depth_m[..., None])[[36, 40], [34, 60]] @ T[:3, :3].T + T[:3, 3]
    press(page, "measure")
    for point in points:
        x, y, _ = page.value(f"sigmasplat.project({point.tolist()})")
        tap(page, x, y)
        settle(page)
    keep(page.screenshot(), f"ruler-{page.screenshot().shape[1]}")
    said = page.value("document.getElementById('hint').innerText")
    length, length_unit, sign, std, std_unit = said.split()
    length_m, std_m = (float(n) * {"m": 1.0, "cm": 0.01}[unit] for n, unit in ((length, length_unit), (std, std_unit)))
    assert length_m == pytest.approx(np.linalg.norm(points[0] - points[1]), rel=0.02)
    assert sign == "±" and std_m == pytest.approx(STD_M * np.sqrt(2.0), abs=6e-4)  # two ends, to the millimetre


def test_a_double_tap_goes_there_and_the_camera_stays_near_what_was_seen(page: Page) -> None:
    before = np.array(page.value("sigmasplat.cam.eye"))
    hit = page.value("sigmasplat.pick(innerWidth / 2, innerHeight / 2)")
    middle = page.value("[innerWidth / 2, innerHeight / 2]")
    now_s = time.time()
    tap(page, *middle, now_s)
    tap(page, *middle, now_s + 0.2)
    settle(page)
    after, point = np.array(page.value("sigmasplat.cam.eye")), np.array(hit["point"])
    assert np.linalg.norm(after - point) < 0.6 * np.linalg.norm(before - point)
    low, high = page.value("sigmasplat.scene.bounds")
    page.value("sigmasplat.setPose([1, 0, 0, 100, 0, -1, 0, 100, 0, 0, -1, 100, 0, 0, 0, 1])")
    assert page.value("sigmasplat.cam.eye") == high and low < high
    press(page, "back")
    assert np.allclose(page.value("sigmasplat.cam.eye"), before, atol=1e-6)


def test_without_webgl_a_sentence_and_a_picture_are_shown(shared: Path, tmp_path: Path) -> None:
    with chromium("about:blank", tmp_path / "profile") as port:
        page = Page(port)
        page.call("Page.enable")
        page.call(
            "Page.addScriptToEvaluateOnNewDocument", source="HTMLCanvasElement.prototype.getContext = () => null"
        )  # fmt: skip
        page.call("Page.navigate", url=shared.as_uri())
        wait_for(lambda: "no WebGL 2" in (page.value("document.getElementById('hint').innerText") or ""))
        assert page.screenshot().std() > 20 and page.value("document.getElementById('poster').naturalWidth") == 96
