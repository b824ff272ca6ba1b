"""The report of a real run: it fits a phone, and its floor plan equals the exported one."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from sigmasplat import cli
from sigmasplat.data.field import GaussianField
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-proxy-server",
    "--hide-scrollbars", "--virtual-time-budget=10000", "--dump-dom",
]  # fmt: skip
SETTINGS = {
    "input.width": "64", "mapping.first_iterations": "20", "mapping.iterations": "5", "final.iterations": "5",
    "submaps.distance_m": "0", "submaps.uncertainty_m": "0", "submaps.frames": "6",
}  # fmt: skip
PHONE_PX, SCREENS = 400, {400: 844, 1280: 800}
"""Width of a phone, and the height of the screen for each width, pixels."""
MOST_SCREENS = 4
# Shows the page in a frame of the size of a screen. Writes its height and where its first picture ends; then, with all
# parts unfolded, the width of its content, and elements whose content is cut off.
FRAME = """<!doctype html>
<iframe id=frame width={width} height={height} style="border: 0" srcdoc="{page}"></iframe><p id=out>
<script>frame.onload = () => {{
  const page = frame.contentDocument, tall = page.documentElement.scrollHeight;
  const picture = page.querySelector("img").getBoundingClientRect().bottom;
  for (const details of page.querySelectorAll("details")) details.open = true;
  const cut = [...page.querySelectorAll("pre, figure, li, p, h1")]
    .filter(element => element.scrollWidth > element.clientWidth + 1).map(element => element.outerHTML.slice(0, 200));
  out.textContent = JSON.stringify({{tall, picture, width: page.documentElement.scrollWidth, cut}});
}}</script>"""


def sigmasplat(*arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert not ended.value.code


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a tiny run of the synthetic room, with several submaps, and its report."""
    folder = tmp_path_factory.mktemp("report") / "a-run-with-a-rather-long-name-of-its-folder-to-see-that-commands-wrap"
    options = [word for pair in SETTINGS.items() for word in ("--set", "=".join(pair))]
    sigmasplat(
        "run", "synthetic:frames=120,width=64,height=48", "--limit", "14", "--out", str(folder), *options
    )  # fmt: skip
    return folder


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium (apt-get install chromium)")
@pytest.mark.parametrize("width", [PHONE_PX, pytest.param(1280, marks=pytest.mark.slow)])
def test_the_report_fits_a_phone_and_a_screen(run: Path, tmp_path: Path, width: int) -> None:
    assert CHROMIUM is not None
    frame, height = tmp_path / "frame.html", SCREENS[width]
    page = html.escape((run / "report.html").read_text())
    frame.write_text(FRAME.format(width=width, height=height, page=page))
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", frame.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    measured = re.search(r"<p id=\"out\">(\{.*\})", shown)
    assert measured, shown[-500:]
    found = json.loads(html.unescape(measured[1]))
    assert height < found["tall"] <= MOST_SCREENS * height
    assert 100 < found["picture"] <= height, "the picture of the map is on the first screen"
    assert (found["width"], found["cut"]) == (width, [])


def test_the_report_shows_the_plan_that_is_exported(run: Path, tmp_path: Path) -> None:
    sigmasplat("export", str(run), "--out", str(tmp_path / "plan.png"))
    exported, page = json.loads((tmp_path / "plan.json").read_text()), (run / "report.html").read_text()
    assert exported["predicted_errors"] and exported["free_m2"] > 0
    assert "<h2>Floor plan</h2>" in page and "What is there" in page and "Depth: standard deviation" in page


def test_predicted_errors_are_scored_and_shown(run: Path) -> None:
    scores = json.loads((run / "metrics.json").read_text())["predictive"]
    assert scores["views"] >= 1
    for quantity in ("color", "depth"):
        found = scores[quantity]
        assert 0 < found["coverage_68"] <= found["coverage_95"] <= 1 and found["pixels"] > 100
        assert 0 <= found["auce"] <= 0.5 and found["ause"] > 0 and found["nll"] < 0
    page = (run / "report.html").read_text()
    (part,) = re.findall(r"<h3>held-out views</h3>(.*?)(?:<h3>|</details>)", page, re.DOTALL)
    assert page.count("alt='predicted colour error'") == part.count("alt='predicted colour error'") > 0
    assert part.count("alt='input'") == part.count("alt='predicted colour error'")
    measured = f"<td>{100 * scores['color']['coverage_68']:.1f}</td>"
    assert measured in page and "Predicted errors, held-out, final map" in page


def test_views_that_calibrated_the_prediction_are_not_scored(run: Path) -> None:
    folder = RunFolder.open(run)
    log, store = folder.read_log(), folder.submaps
    probes = [frame for i in range(len(store)) for frame in store.load(i).probe_frames]
    held_out = [record for record in log if not record["is_keyframe"] and not record["lost"]]
    metrics = folder.read_metrics()
    assert probes and metrics["held_out"]["views"] == len(held_out)
    assert metrics["predictive"]["views"] == len(held_out) - len(probes)


def test_without_the_uncertainty_of_the_map_nothing_is_predicted(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    for name in ("uncertainty.json", "uncertainty.safetensors"):
        (copy / name).unlink()
    sigmasplat("eval", str(copy))
    assert json.loads((copy / "metrics.json").read_text())["predictive"] is None
    page = (copy / "report.html").read_text()
    assert "predicted colour error" not in page and "Depth: standard deviation" not in page
    assert "The run has no predicted errors" in page


def test_the_uncertainty_of_another_map_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    folder = RunFolder.open(copy)
    folder.write_map(GaussianField(folder.read_map().params[:-1]))
    with pytest.raises(SystemExit) as ended:
        cli.main(["eval", str(copy)])
    assert ended.value.code and "uncertainty.safetensors" in capsys.readouterr().err
