"""A page in headless Chromium with software WebGL, driven through the DevTools protocol."""

import base64
import io
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTH, HEIGHT = 800, 600
"""Size of the window."""
FLAGS = [
    "--headless=new", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--no-proxy-server",
    "--remote-debugging-port=0", f"--window-size={WIDTH},{HEIGHT}",
]  # fmt: skip
PATIENCE_S = 120.0
Pixels = NDArray[np.uint8]


class Page:
    """A page, and what went wrong in it: `problems`, as the protocol reports it."""

    def __init__(self, port: int) -> None:
        from websockets.sync.client import connect

        self.calls, self.problems = 0, list[dict[str, Any]]()
        pages: list[dict[str, str]] = []
        wait_for(lambda: pages.extend(p for p in _pages(port) if p["type"] == "page") or bool(pages))
        self.socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=None)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.calls += 1
        self.socket.send(json.dumps({"id": self.calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self.socket.recv(timeout=PATIENCE_S))
            if answer.get("id") == self.calls:
                assert "error" not in answer, answer
                return dict(answer["result"])
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.problems.append(answer["params"])

    def value(self, expression: str) -> Any:
        """Return the value of an expression in the page; None if a part of it does not exist yet."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return found["result"].get("value")

    def screenshot(self) -> Pixels:
        """Return the content of the window [H, W, 3]."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def click(self, expression: str) -> None:
        """Click the middle of an element with the mouse, as soon as it exists."""
        wait_for(lambda: bool(self.value(f"!!{expression}")))
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])(({expression}).getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


def _pages(port: int) -> list[dict[str, str]]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as answer:
        return list(json.load(answer))


@contextmanager
def chromium(url: str, profile: Path) -> Iterator[int]:
    """Open a page in a new Chromium process with an empty profile; yield the port of the protocol, and end the process
    in any case."""
    assert CHROMIUM is not None
    process = subprocess.Popen(
        [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        told = profile / "DevToolsActivePort"
        wait_for(lambda: told.is_file() and "\n" in told.read_text())
        yield int(told.read_text().split()[0])
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def wait_for(happened: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < deadline_s, "nothing happened"
        time.sleep(0.3)


def keep(pixels: Pixels, name: str) -> None:
    """Write a screenshot to the folder $SIGMASPLAT_SCREENSHOTS, if it is set, for a person to look at."""
    if folder := os.environ.get("SIGMASPLAT_SCREENSHOTS"):
        Image.fromarray(pixels).save(Path(folder) / f"{name}.png")
