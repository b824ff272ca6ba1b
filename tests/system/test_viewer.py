"""The viewer in a real browser (headless Chromium, software WebGL): screenshots of a finished run and of a live one."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from headless_browser import CHROMIUM, PATIENCE_S, WIDTH, Page, Pixels, chromium, keep, wait_for
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.session import Session
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
pytest.importorskip("viser", reason="viser is not installed (pip install 'sigmasplat[viewer]')")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium)")

PANEL = 340
"""Width of the panel on the right side of the window."""
QUICK = {"input.width": "64", "mapping.first_iterations": "20", "mapping.iterations": "5", "submaps.distance_m": "0",
         "submaps.uncertainty_m": "0", "submaps.frames": "6", "loops.close": "no",
         "final.iterations": "5"}  # fmt: skip


class Browser(Page):
    """The viewer in headless Chromium."""

    def scene(self) -> Pixels:
        """Return the part beside the panel, without the notice about software WebGL at the top."""
        return self.screenshot()[200:, : WIDTH - PANEL]

    def text(self) -> str:
        """Return the text of the page."""
        words = "document.body ? document.body.innerText : ''"  # a newly opened page has no body yet
        return str(self.value(words))

    def choose(self, label: str, option: str) -> None:
        """Select an option of a dropdown, found by its label, with the mouse."""
        beside = f"[...document.querySelectorAll('label')].find(l => l.innerText.trim() == {json.dumps(label)})"
        self.click(f"document.getElementById({beside}.htmlFor)")
        spoken = "[...document.querySelectorAll('[role=option]')].find(o => o.offsetParent && o.innerText.trim() == "
        self.click(f"{spoken}{json.dumps(option)})")


@contextmanager
def browser(url: str, profile: Path) -> Iterator[Browser]:
    with chromium(url, profile) as port:
        yield Browser(port)


@contextmanager
def sigmasplat(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a command that starts a viewer; yield the process and the address that it printed."""
    command = [sys.executable, "-u", "-m", "sigmasplat.cli", *arguments, "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        said = ""
        while not said.startswith("viewer: "):
            said = process.stdout.readline()
            assert said or process.poll() is None, f"ended with {process.poll()}"
        yield process, said.split()[1]
    finally:
        process.kill()
        process.communicate()


def colours(pixels: Pixels) -> int:
    """Count the different colours, with eight levels per channel."""
    return len(np.unique((pixels // 32).reshape(-1, 3), axis=0))


def likeness(pixels: Pixels, map_colours: NDArray[np.float64]) -> float:
    """Return the share of the non-background pixels whose colours are near a colour map."""
    ramp = colormap.apply(np.linspace(0, 1, 64), 0.0, 1.0, map_colours).astype(int)
    lit = pixels.reshape(-1, 3).astype(int)
    lit = lit[lit.max(1) > 60]
    away = np.abs(lit[:, None] - ramp).max(2).min(1)
    return float((away < 24).mean()) if len(lit) else 0.0


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Record a very small run."""
    config = override(preset(default_preset()), QUICK)
    source = open_source("synthetic:frames=120,width=64,height=48", override(config, {"input.limit": "14"}).input)
    run = RunFolder.create(tmp_path_factory.mktemp("viewer") / "tiny", config, "room")
    Session(Slam(config, run.submaps), source, run).execute()
    return run


@pytest.mark.slow
def test_a_finished_run_shows_its_map_and_its_uncertainty(finished: RunFolder, tmp_path: Path) -> None:
    with sigmasplat("view", str(finished.path)) as (process, url), browser(url, tmp_path / "profile") as page:
        assert url.startswith("http://127.0.0.1:")
        wait_for(lambda: "14 frames" in page.text() and colours(page.scene()) > 8)
        plain = page.screenshot()
        keep(plain, "finished")
        page.choose("colours", "how unsure")
        wait_for(lambda: likeness(page.scene(), colormap.INFERNO) > 2 * likeness(scene_of(plain), colormap.INFERNO))
        keep(page.screenshot(), "sigma")
        by_sigma = page.scene()
        assert np.abs(by_sigma.astype(int) - scene_of(plain)).mean() > 10
        page.choose("show", "distance from here")
        wait_for(lambda: likeness(page.scene(), colormap.VIRIDIS) > 0.3)
        keep(page.screenshot(), "depth")
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0 and "Traceback" not in said


def scene_of(screenshot: Pixels) -> Pixels:
    return screenshot[200:, : WIDTH - PANEL]


@pytest.mark.slow
def test_a_live_run_shows_its_map_while_it_grows_and_stays_until_ctrl_c(tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = [word for pair in QUICK.items() for word in ("--set", "=".join(pair))]
    room = ["synthetic:frames=4000,width=64,height=48", "--out", str(out), "--no-eval", "--view"]
    with sigmasplat("run", *room, *options) as (process, url), browser(url, tmp_path / "profile") as page:
        wait_for(lambda: "(running)" in page.text() and colours(page.scene()) > 8)
        before = len(RunFolder(out).read_log())
        keep(page.screenshot(), "live")
        wait_for(lambda: len(RunFolder(out).read_log()) > before + 20)
        assert process.poll() is None and "(running)" in page.text()
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130 and "Traceback" not in said and "viewer: Error" not in said
    assert RunFolder.open(out).facts()["status"] == "interrupted"
