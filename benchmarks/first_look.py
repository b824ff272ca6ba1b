"""Measure what a person waits for before a map is seen: the viewer and a shared page in Chromium (issue 62).

Every finished run is shared as a page, which is opened from the disk at the sizes of a desktop and of a phone, and it
is shown by `sigmasplat view`, behind a relay that counts bytes. Each opening is a new Chromium with an empty cache and
software WebGL. The first picture is there when the first draw of splats has finished; frames per second are counted
while the mouse drags. Needs an idle machine: the load before is kept and stands below the table.
Writes benchmarks/results/first-look-<machine>.json and prints the table.

example: sigmasplat run DATA/fr1_xyz --out runs/desk && python benchmarks/first_look.py runs/desk
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from socket import create_connection, socket
from socketserver import BaseRequestHandler, ThreadingTCPServer
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Annotated, Any

import program
import record
import tyro
from tables import Section, significant

from sigmasplat.errors import SigmaSplatError
from sigmasplat.run_folder.runs import RunFolder

sys.path.append(str(record.ROOT / "tests"))
from headless_browser import CHROMIUM, Page, chromium, wait_for

arg = tyro.conf.arg
HOST = "127.0.0.1"
DESKTOP, PHONE = (1280, 800), (390, 844)
DRAG_S, BUSY = 5.0, 0.5
"""How long the mouse drags; the load per core above which the figures are not those of an idle machine."""
SPY = """
(() => {
  const seen = window.firstLook = { first_ms: null, frames: 0 };
  let last = null;
  for (const [name, at] of [["drawArraysInstanced", 3], ["drawElementsInstanced", 4]]) {
    const plain = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      plain.apply(this, given);
      if (!(given[at] > 1000)) return; // not the splats
      if (seen.first_ms === null) {
        this.readPixels(0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, new Uint8Array(4)); // waits until it is drawn
        seen.first_ms = performance.now();
      }
      seen.frames += last !== document.timeline.currentTime;
      last = document.timeline.currentTime;
    };
  }
})();
"""
"""Notes in a page when splats were drawn first, in ms after its opening, and counts the frames with splats."""


@dataclass(frozen=True)
class Options:
    """Measure what a person waits for before a map is seen."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, arg(help="folders of finished runs")]
    name: Annotated[str, arg(help="name of the results")] = "first-look"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


class Relay(ThreadingTCPServer):
    """Passes connections on to a port of this machine; counts the bytes of its answers, those of websockets apart."""

    daemon_threads = True

    def __init__(self, port: int) -> None:
        super().__init__((HOST, 0), _Passing)
        self.port, self.page_bytes, self.data_bytes = port, 0, 0


class _Passing(BaseRequestHandler):
    def handle(self) -> None:
        relay = self.server
        assert isinstance(relay, Relay)
        with create_connection((HOST, relay.port)) as there:
            first = self.request.recv(65536)
            is_data = b"upgrade: websocket" in first.lower()
            there.sendall(first)
            Thread(target=_pass_on, args=(self.request, there), daemon=True).start()
            while data := _received(there):
                relay.data_bytes += len(data) * is_data
                relay.page_bytes += len(data) * (not is_data)
                try:
                    self.request.sendall(data)
                except OSError:
                    return  # the browser has gone


def _pass_on(source: socket, target: socket) -> None:
    while data := _received(source):
        try:
            target.sendall(data)
        except OSError:
            return


def _received(source: socket) -> bytes:
    try:
        return source.recv(65536)
    except OSError:
        return b""


def show(page: Page, url: str, width: int, height: int) -> None:
    """Open an address in a window of this size, and wait for its first picture."""
    page.call("Page.enable")
    page.call("Page.addScriptToEvaluateOnNewDocument", source=SPY)
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    page.call("Page.navigate", url=url)
    wait_for(lambda: bool(page.value("window.firstLook && firstLook.first_ms")))


def opened(url: str, size: tuple[int, int]) -> dict[str, float]:
    """Open a page in a new Chromium; return the time to its first picture, and its frames per second under a drag."""
    width, height = size
    with TemporaryDirectory(prefix="first-look-") as profile, chromium("about:blank", Path(profile)) as port:
        page = Page(port)
        show(page, url, width, height)
        time.sleep(2.0)  # what is loaded after the first picture does not count as movement
        return {"first_s": page.value("firstLook.first_ms") / 1000.0, "frames_per_s": dragged(page, width, height)}


def dragged(page: Page, width: int, height: int) -> float:
    """Return the frames per second while the mouse drags to and fro over the middle of a page."""
    mouse: dict[str, Any] = {"button": "left", "clickCount": 1}
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=width // 3, y=height // 2, **mouse)
    before, begun_s, moves = page.value("firstLook.frames"), time.perf_counter(), 0
    while time.perf_counter() - begun_s < DRAG_S:
        x = width // 3 + abs(4 * moves % 200 - 100)
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=height // 2, buttons=1, **mouse)
        moves += 1
        time.sleep(0.02)
    frames, now_s = page.value("firstLook.frames") - before, time.perf_counter() - begun_s
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=width // 3, y=height // 2, **mouse)
    return float(frames / now_s)


@contextmanager
def viewed(run: Path) -> Iterator[tuple[int, float]]:
    """Start `sigmasplat view`; yield its port and the seconds until it printed its address."""
    begun_s = time.perf_counter()
    command = [sys.executable, "-u", "-m", "sigmasplat", "view", str(run), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        said = ""
        while not said.startswith("viewer: "):
            if not (line := process.stdout.readline()):
                raise SigmaSplatError(f"sigmasplat view {run} ended: {said.strip()}")
            said = line
        yield int(said.split()[1].rsplit(":", 1)[1]), time.perf_counter() - begun_s
    finally:
        process.kill()
        process.wait()


def of_the_viewer(run: Path) -> dict[str, Any]:
    """Measure the viewer of a run."""
    with viewed(run) as (port, ready_s), Relay(port) as relay:
        Thread(target=relay.serve_forever, daemon=True).start()
        try:
            figures = opened(f"http://{HOST}:{relay.server_address[1]}", DESKTOP)
        finally:
            relay.shutdown()
        sizes = {"page_bytes": relay.page_bytes, "data_bytes": relay.data_bytes}
    return {"shown": "viewer", "size": DESKTOP, "ready_s": ready_s} | sizes | figures


def of_the_shared_page(run: Path) -> list[dict[str, Any]]:
    """Measure the shared page of a run, at the size of a desktop and of a phone."""
    with TemporaryDirectory(prefix="first-look-") as folder:
        out = Path(folder) / "page.html"
        begun_s = time.perf_counter()
        subprocess.run([sys.executable, "-m", "sigmasplat", "share", str(run), "--out", str(out)], check=True)
        facts = {"ready_s": time.perf_counter() - begun_s, "page_bytes": out.stat().st_size, "data_bytes": None}
        return [
            {"shown": "shared page", "size": size} | facts | opened(out.as_uri(), size) for size in (DESKTOP, PHONE)
        ]


def measure(options: Options) -> dict[str, Any]:
    """Measure every run; return the figures. Raises SigmaSplatError without Chromium or for a run that is not there."""
    if CHROMIUM is None:
        raise SigmaSplatError("Chromium is not installed (apt-get install chromium)")
    rows = []
    for path in options.runs:
        run = RunFolder.open(path)
        facts = {"run": run.facts()["source"], "splats": len(run.read_map())}
        rows += [facts | row for row in (of_the_viewer(path), *of_the_shared_page(path))]
    return {"load_average": record.LOAD_AVERAGE, "pages": rows}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the figures, one row for each run: the viewer, the shared page, and that page at the size of a phone."""
    figures, cores = measured["figures"], measured["machine"]["cores"]
    rows, pages = [], figures["pages"]
    for name in dict.fromkeys(page["run"] for page in pages):
        viewer, shared, phone = (page for page in pages if page["run"] == name)
        both = (viewer["page_bytes"] + viewer["data_bytes"]) / 1e6, shared["page_bytes"] / 1e6
        times = [page[kind] for kind in ("first_s", "frames_per_s") for page in (viewer, shared, phone)]
        rows.append([name, f"{viewer['splats']:,}", *map(significant, (*both, *times))])
    opens = [f"{how}, {unit}" for unit in ("s", "frames/s") for how in ("viewer", "page", "phone")]
    load = figures["load_average"]
    idle = "" if load <= BUSY * cores else ", so others were using the machine"
    note = f"MB sent; seconds to the first picture; frames/s under a drag. Load average before: {load:.2f}{idle}."
    return [Section("First look", ["run", "splats", "viewer, MB", "page, MB", *opens], rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    busy = BUSY * (os.cpu_count() or 1)
    if busy < record.LOAD_AVERAGE:
        print(f"first_look.py: the load is {record.LOAD_AVERAGE}: times will be long", file=sys.stderr)
    return program.run("first_look", options, measure)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
