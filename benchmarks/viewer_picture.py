"""Draw the picture of the viewer that docs/viewer.md shows: a run as it opens, the right side by how unsure it is.

Shows a finished run to headless Chromium and measures nothing. The recording of the committed picture is fr1/xyz of TUM
RGB-D (J. Sturm et al., IROS 2012; CC BY 4.0).

example: sigmasplat run DATA/fr1_xyz --out runs/desk && python benchmarks/viewer_picture.py runs/desk
"""

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import record
import tyro
from first_look import HOST, show
from PIL import Image

from sigmasplat.errors import SigmaSplatError
from sigmasplat.run_folder.runs import RunFolder

sys.path.append(str(record.ROOT / "tests"))
from headless_browser import Page, Pixels, chromium, wait_for

arg = tyro.conf.arg
WIDTH, HEIGHT, SPLIT, GAP = 1240, 680, 700, 4
"""Size of the window, the column from which on it is coloured by how unsure it is, and the width of the line there,
pixels. The viewer's panel is on the right side."""
NOTICE = "document.querySelectorAll('[class*=Notification-root]').forEach(e => e.remove())"
"""Removes the note that WebGL is drawn by software."""
Run = Annotated[Path, tyro.conf.Positional, arg(help="folder of a finished run")]
Out = Annotated[Path, arg(help="picture to write")]


def settled(page: Page) -> Pixels:
    """Return the window as soon as it has stopped changing."""
    seen = [page.screenshot()]

    def still() -> bool:
        time.sleep(1.5)
        seen.append(page.screenshot())
        return bool(np.array_equal(*seen[-2:]))

    wait_for(still)
    return seen[-1]


def halves(run: RunFolder) -> tuple[Pixels, Pixels]:
    """Return the window with a run as it opens, and coloured by how unsure it is. Raises RunError, SigmaSplatError."""
    from sigmasplat.plugins.viewer.server import close, open_server

    server = open_server(HOST, 8790, "SigmaSplat")
    from sigmasplat.plugins.viewer.app import ViewerApp
    from sigmasplat.plugins.viewer.snapshot_sources import finished_snapshot

    viewer = ViewerApp(server)
    try:
        viewer.show(finished_snapshot(run))
        with TemporaryDirectory(prefix="viewer-") as profile, chromium("about:blank", Path(profile)) as port:
            page = Page(port)
            show(page, f"http://{HOST}:{server.get_port()}", WIDTH, HEIGHT)
            viewer.panel.floating.value = False
            page.value(NOTICE)
            own = settled(page)
            viewer.panel.colouring.value = "how unsure"
            time.sleep(2.0)
            return own, settled(page)
    finally:
        viewer.stop()
        close(server)


def main(run: Run, out: Out = record.ROOT / "docs" / "images" / "viewer.jpg") -> int:
    """Draw the picture of the viewer; exit code 2 if the run cannot be shown."""
    try:
        own, unsure = halves(RunFolder.open(run))
    except SigmaSplatError as problem:
        print(f"viewer_picture.py: {problem}", file=sys.stderr)
        return 2
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    drawn = np.concatenate([own[:, :SPLIT], gap, unsure[:, SPLIT:]], axis=1)
    Image.fromarray(drawn).save(out, quality=85, optimize=True)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,)))
