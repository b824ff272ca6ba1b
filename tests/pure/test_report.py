"""Charts, view strips and the page: colours match their bar, strips show their panels, the page is complete."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image, ImageFont

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.evaluation.report import charts
from sigmasplat.plugins.evaluation.report.page import address, build_report
from sigmasplat.plugins.evaluation.report.summary import Verdict
from sigmasplat.plugins.evaluation.report.tables import key_figures
from sigmasplat.plugins.evaluation.view_scores import PredictedErrors, ScoredView
from sigmasplat.plugins.outputs.drawing import colormap, plot
from sigmasplat.plugins.outputs.drawing.view_panels import (
    GAP,
    HEAD,
    PANEL_WIDTH,
    ViewPanel,
    draw_view_strip,
    view_panels,
)
from sigmasplat.run.figures import number, rate
from sigmasplat.run_folder.frames import RunFrames

PLOTS = {"trajectory": (charts.trajectory_charts(np.eye(3), None), "caption")}
NAMESPACE = "http://www.w3.org/2000/svg"


def plain(title: str, gray: int, caption: str = "") -> ViewPanel:
    """Return a panel of one gray value."""
    return ViewPanel(title, np.full((30, 40, 3), gray, np.uint8), caption)


STRIPS = {"held-out views": [[plain("input", 5)]]}
VOID = {"meta", "img", "source", "br", "!doctype"}


def some_view(seed: int = 0) -> ScoredView:
    rng = np.random.default_rng(seed)
    color = rng.uniform(size=(30, 40, 3)).astype(np.float32)
    depth = rng.uniform(1, 3, (30, 40)).astype(np.float32)
    depth[:10] = 0.0
    alpha = np.full((30, 40), 0.9, np.float32)
    alpha[20:] = 0.1
    rendered_depth = np.where(alpha > 0.5, depth + 0.1, 0).astype(np.float32)
    variance = np.full((30, 40, 3), 0.04, np.float32)
    return ScoredView(
        12, "held-out", color, depth, np.clip(color + 0.1, 0, 1), rendered_depth, alpha, variance, ("lost",)
    )


def predicted_view() -> ScoredView:
    """Predict a standard deviation of 0.5 for colour, and of 0.2 m for depth."""
    return replace(some_view(), predicted=PredictedErrors(*(np.full((30, 40), v, np.float32) for v in (0.25, 0.04))))


@pytest.mark.parametrize("colours", [colormap.VIRIDIS, colormap.INFERNO])
def test_brightness_rises_along_a_palette(colours: np.ndarray) -> None:
    ramp = colormap.apply(np.linspace(0, 1, 200), 0, 1, colours).astype(float)
    brightness = ramp @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > -0.5).all() and brightness[-1] - brightness[0] > 150


def test_values_outside_the_range_are_clipped_and_invalid_ones_are_slate() -> None:
    values = np.array([[-5.0, 0.0, 1.0, 9.0]])
    out = colormap.apply(values, 0.0, 1.0)
    assert (out[0, 0] == out[0, 1]).all() and (out[0, 2] == out[0, 3]).all() and tuple(out[0, 0]) == (68, 1, 84)
    holes = colormap.apply_masked(values, np.array([[True, False, True, True]]), 0.0, 1.0, colormap.VIRIDIS)
    assert tuple(holes[0, 1]) == colormap.NO_READING
    assert colormap.value_range(values, np.zeros_like(values, bool)) == (0.0, 1.0)
    colormap.apply(values, 2.0, 2.0)


def test_scores_of_a_view_use_pixels_with_a_depth_reading() -> None:
    view = some_view()
    score = view.scores()
    valid = np.zeros((30, 40), bool)
    valid[10:] = True
    mse = ((view.rendered - view.recorded)[valid].astype(float) ** 2).mean()
    assert score["psnr_db"] == pytest.approx(-10 * np.log10(mse))
    assert score["depth_l1_m"] == pytest.approx(0.1, abs=1e-5) and score["depth_coverage"] == pytest.approx(0.5)
    np.testing.assert_allclose(view.uncertainty, 0.04)


def test_the_font_has_every_character_of_the_panels() -> None:
    font = ImageFont.load_default(20)
    panels = [*view_panels(some_view()), *view_panels(predicted_view())]
    texts = [word for panel in panels for word in (panel.title, panel.caption, *panel.ends)]
    missing = bytes(font.getmask("\uffff"))
    assert not [c for c in sorted({*"".join(texts)} - {" "}) if bytes(font.getmask(c)) == missing]


def test_a_strip_shows_the_five_panels_of_a_view() -> None:
    view = some_view()
    for word, shown in zip(("input", "colour", "depth", "V", "error"), view_panels(view), strict=True):
        assert word in shown.title
    strip = np.asarray(draw_view_strip(view_panels(view)), float)
    assert strip.shape[1] == 5 * (PANEL_WIDTH + GAP) + GAP

    def panel(i: int) -> np.ndarray:
        left = GAP + i * (PANEL_WIDTH + GAP)
        return strip[HEAD : HEAD + 240, left : left + PANEL_WIDTH]

    shown = Image.fromarray((view.recorded * 255).round().astype(np.uint8)).resize((320, 240), Image.Resampling.LANCZOS)
    np.testing.assert_allclose(panel(0), np.asarray(shown, float))
    assert (panel(2)[-70:] == colormap.NO_READING).all(), "no surface there"
    assert (panel(4)[:70] == colormap.NO_READING).all(), "no depth reading"
    # V is the same at every mapped pixel: one colour, and the bar ends at its root, 0.2.
    assert len(np.unique(panel(3)[:150].reshape(-1, 3), axis=0)) == 1 and view_panels(view)[3].ends[1] == "0.200"


def test_predicted_errors_are_shown_at_the_scale_of_the_errors() -> None:
    """The largest colour error of the view is about 0.1, the prediction 0.5, also where the map is empty."""
    *_, predicted, error = view_panels(predicted_view())
    assert predicted.title == "predicted colour error" and predicted.ends[1] == error.ends[1] == "0.500"
    brightest = colormap.INFERNO[-1].astype(np.uint8)
    assert (predicted.pixels == brightest).all() and error.pixels[10:].sum(-1).max() < brightest.sum()


def test_ticks_are_round_and_few() -> None:
    for low, high in [(-0.3, 1.7), (0, 1e-4), (-2000, 5), (3.1, 3.9)]:
        ticks = plot.nice_ticks(low, high)
        assert 2 <= len(ticks) <= 12 and ticks[0] >= low - 1e-9 and ticks[-1] <= high + 1e-9
        leading = float(f"{ticks[1] - ticks[0]:e}".split("e")[0])
        assert round(leading, 6) in (1, 2, 5)


NUMBER = re.compile(r"-?[\d.]+")


def drawn(chart: plot.Chart) -> list[tuple[str, np.ndarray]]:
    """Return the colour and the points [N, 2] in pixels of the curves of a chart, as its SVG shows them."""
    found = re.findall(r"<path d='([^']*)' stroke='var\(--c(\d)\)'", plot.svg(chart))
    return [(colour, np.array(NUMBER.findall(d.replace("h0", "")), float).reshape(-1, 2)) for d, colour in found]


def test_both_axes_of_a_path_have_one_scale() -> None:
    """A path around a 2 m × 2 m square is also a square in pixels, in the colour of the estimate; forward is up."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 0, 2], [0, 0, 2], [0, 0, 0.0]])
    ((colour, places),) = drawn(charts.trajectory_charts(corners, None)[0])
    width, height = np.ptp(places, axis=0)
    assert width == pytest.approx(height, abs=0.3) and width > 150 and colour == str(plot.ACCENT)
    assert places[2, 1] < places[1, 1] and places[1, 0] > places[0, 0]


def test_a_chart_is_a_whole_file_for_light_and_dark_pages() -> None:
    page = plot.svg(
        plot.Chart("a < b", "x & y", "", [plot.Curve("one", np.eye(2), 0), plot.Curve("two", np.eye(2), 1)])
    )
    root = ElementTree.fromstring(page)
    texts = "".join(root.itertext())
    assert all(words in texts for words in ("a < b", "x & y", "● one", "● two"))
    assert "prefers-color-scheme: dark" in texts
    for colours in (plot.LIGHT, plot.DARK):
        assert all(f"--c{k}: rgb({r} {g} {b})" in texts for k, (r, g, b) in enumerate(colours))


def test_height_points_up_and_the_truth_may_have_gaps() -> None:
    estimate = np.array([[0, 0, 0], [0, -1.5, 0], [0, -3, 0.0]])
    truth = estimate.copy()
    truth[1] = np.nan
    laid_out = charts.trajectory_charts(estimate, truth, np.array([False, True, False]))
    assert [curve.name for curve in laid_out[1].curves] == ["recorded", "estimate", "lost"]
    assert laid_out[1].curves[1].points[:, 1].tolist() == [0, 1.5, 3]
    estimate_shown = drawn(laid_out[1])[1][1]
    assert (np.diff(estimate_shown[:, 1]) < 0).all() and [len(places) for _, places in drawn(laid_out[1])] == [2, 3, 1]


def test_a_static_camera_and_a_single_frame_can_be_drawn() -> None:
    for n in (1, 5):
        for chart in charts.trajectory_charts(np.zeros((n, 3)), None):
            ((_, places),) = drawn(chart)
            assert len(places) == n and np.isfinite(places).all()


def test_vast_values_are_left_out_and_equal_ones_have_an_axis() -> None:
    for values, kept in (([0.0, 1.0, 1e308, -1e308], 2), ([1e20] * 3, 3), ([-1e90, 1e90], 2), ([np.nan] * 2, 0)):
        for chart in charts.trajectory_charts(np.array([values] * 3).T, None):
            ((_, places),) = drawn(chart)
            assert len(places) == kept and "nan" not in plot.svg(chart)


def test_the_last_poses_before_lost_frames_are_marked() -> None:
    rows = np.array([0, 1, 3, 4, 5, 7, 8])
    log = [{"index": 10 * row, "timestamp_s": float(row), "lost": row in (2, 6)} for row in range(9)]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, 0, 3] = rows
    path = Trajectory(rows.astype(np.float64), poses)
    new = [record | {"state": "lost" if record["lost"] else "tracked"} for record in log]
    made = charts.run_charts(RunFrames.of(new, path), None)
    lost = next(curve for curve in made["trajectory"][0][0].curves if curve.name == "lost")
    assert lost.points[:, 0].tolist() == [1, 5]
    calm = [record | {"lost": False} for record in log[:2]]
    assert set(charts.run_charts(RunFrames.of(calm, path.at(np.arange(2))), None)) == {"trajectory"}


def test_the_strip_shows_each_range_of_frames_in_one_state() -> None:
    states = ["tracked", "tracked", "lost", "relocalised", "tracked", "lost", "lost", "apart"]
    log = [{"index": 2 * i, "timestamp_s": float(i), "lost": s == "lost", "state": s, "p_off": 0.1 * i}
           for i, s in enumerate(states)]  # fmt: skip
    valid = [0, 1, 3, 4]
    path = Trajectory(np.array(valid, np.float64), np.tile(np.eye(4), (4, 1, 1)))
    found = charts.run_charts(RunFrames.of(log, path), None)
    strip, along = found["states"][0]
    ranges = [(c.colour, *c.points[:, 0]) for c in strip.curves[1:]]
    colours = charts.STATE_COLOURS
    assert sorted(ranges, key=lambda r: r[1]) == [
        (colours["tracked"], -0.5, 2.5), (colours["lost"], 3.5, 4.5), (colours["relocalised"], 5.5, 6.5),
        (colours["tracked"], 7.5, 8.5), (colours["lost"], 9.5, 12.5), (colours["apart"], 13.5, 14.5),
    ]  # fmt: skip
    assert {c.name for c in strip.curves if c.name} == {"tracked", "relocalised", "lost", "apart"}
    assert sum(len(c.points) for c in along.curves if c.dots) == 4, "only valid frames have a place"
    assert len(drawn(strip)) == len(strip.curves) and len(drawn(along)) == len(along.curves)


class Balance(HTMLParser):
    """Collect tags that are closed without being open, and all addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.addresses: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        self.text.append(data)


METRICS = {
    "frames": 200, "lost": 0, "splats": 123456, "frames_per_s": 3.21,
    "ate": {"rmse_m": 0.0123, "mean_m": 0.01, "median_m": 0.009, "max_m": 0.03, "pairs": 200},
    "rpe": {"translation_rmse_m": 0.001, "rotation_rmse_deg": 0.05, "pairs": 199, "delta_frames": 1},
    "training": {"views": 40, "psnr_db": 31.25, "ssim": 0.95, "depth_l1_m": 0.01, "depth_coverage": 0.99},
    "held_out": {"views": 40, "psnr_db": 29.5, "ssim": 0.94, "depth_l1_m": 0.012, "depth_coverage": 0.98},
    "uncertainty": {"pixels": 8, "spearman": 0.412, "spearman_covered": 0.5, "nll": -2.5, "ause": 0.2,
                    "mean_variance": 0.001, "mean_squared_error": 0.002},
}  # fmt: skip


@pytest.mark.parametrize("metrics", [METRICS, {"frames": 0}], ids=["full", "bare"])
def test_the_page_is_complete_and_needs_no_other_file(metrics: dict[str, object]) -> None:
    page = build_report(
        "SigmaSplat · <room> & more", "fast", metrics, STRIPS, PLOTS,
        '{"name": "</pre><script>"}', ["estimate and truth share no timestamps"],
    )  # fmt: skip
    reader = Balance()
    reader.feed(page)
    assert not reader.wrong and not reader.open
    assert set(reader.addresses) == {address(plain("input", 5))} and page.count("<svg") == page.count("</svg>") == 2
    assert "http" not in page.replace(NAMESPACE, "") and "<script" not in page and "prefers-color-scheme: dark" in page
    text = "".join(reader.text)
    assert "<room> & more" in text and "</pre><script>" in text and "share no timestamps" in text


class Tables(HTMLParser):
    """Collect the classes of the elements around each table."""

    def __init__(self) -> None:
        super().__init__()
        self.classes: list[str] = []
        self.around: list[list[str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.around.append([*self.classes])
        if tag not in VOID:
            self.classes.append(dict(attrs).get("class") or "")

    def handle_endtag(self, tag: str) -> None:
        self.classes.pop()


def test_the_page_adapts_to_narrow_screens() -> None:
    """Tables scroll inside their cards, commands wrap, columns fit a phone, and charts are as wide as their column."""
    advice = [("Try this:", "sigmasplat run a-long-path")]
    page = build_report("t", "s", IN_SUBMAPS, STRIPS, PLOTS, advice=advice)
    reader = Tables()
    reader.feed(page)
    assert len(reader.around) >= 4 and all("card" in classes for classes in reader.around)
    style = page[page.index("<style>") : page.index("</style>")]
    for element, rule in ((".card", "overflow-x: auto"), ("pre", "white-space: pre-wrap"), (".chart", "width: 100%")):
        assert re.search(rf"^{re.escape(element)} {{[^}}]*{rule}", style, re.MULTILINE), element
    widths = [int(px) for px in re.findall(r"minmax\((\d+)px", style)]
    assert widths and max(widths) <= 376 // 2
    assert "width=device-width" in page


def test_the_page_shows_the_measured_figures() -> None:
    page = build_report("t", "s", METRICS)
    text = re.sub("<[^>]+>", " ", page)
    for figure in ("1.23", "29.50", "31.25", "0.9500", "0.412", "123\u202f456", "3.21", "−2.500", "98.0"):
        assert figure in text, figure


BEFORE = {"views": 40, "psnr_db": 27.75, "ssim": 0.9, "depth_l1_m": 0.02, "depth_coverage": 0.97}
IN_SUBMAPS = METRICS | {
    "submaps": 8, "loops": {"tried": 3, "accepted": 1}, "finish_s": 12.5, "held_out_submaps": BEFORE,
    "training_submaps": BEFORE | {"psnr_db": 26.5}, "uncertainty_final": METRICS["uncertainty"] | {"spearman": 0.222},
}  # fmt: skip


def test_scores_in_submaps_and_loops_are_shown() -> None:
    text = " ".join(re.sub("<[^>]+>", " ", build_report("t", "s", IN_SUBMAPS)).split())
    for figure in ("Submaps; loops accepted 8; 1 of 3", "12.5 s", "27.75", "26.50", "0.222"):
        assert figure in text, figure


def test_absent_figures_are_dashes() -> None:
    assert number(None, 2) == number(float("nan"), 1) == "–" and number(-1234.5, 1) == "−1\u202f234.5"
    assert dict((name, value) for name, value, _ in key_figures({"held_out": None}))["PSNR, held-out images"] == "–"


def test_the_path_has_no_error_without_ground_truth() -> None:
    assert "ATE RMSE" in {name for name, _, _ in key_figures(METRICS)}
    assert not [name for name, _, _ in key_figures(METRICS | {"ate": None}) if name.startswith("ATE")]


def test_the_terminal_shows_at_most_six_figures() -> None:
    found = {name: f"{value} {unit}" for name, value, unit in key_figures(IN_SUBMAPS | {"apart": 3, "lost": 2})}
    assert len(found) == 6 and found["Images with a pose"] == "195 of 200"
    assert found["Map"] == "123\u202f456 splats, – MB"
    every_frame_mapped = key_figures(METRICS | {"held_out": None})
    assert ("PSNR, training images", "31.25", "dB") in every_frame_mapped


def test_a_slow_speed_is_given_in_seconds_per_image() -> None:
    assert [rate(v) for v in (None, 12.34, 1.0, 0.04)] == [
        "– images per second", "12.3 images per second", "1.0 images per second", "25.0 s per image",
    ]  # fmt: skip


def test_the_time_of_the_final_map_is_shown() -> None:
    figures = re.sub("<[^>]+>", " ", build_report("t", "s", METRICS | {"finish_s": 30.0, "total_s": 40.0}))
    assert "Final map  30.0 s" in figures and "Frames and final map  40.0 s" in figures
    assert "Final map" not in re.sub("<[^>]+>", " ", build_report("t", "s", METRICS | {"finish_s": None}))


def test_the_map_and_the_verdicts_come_first_and_the_rest_is_folded() -> None:
    views = [[plain(f"panel {k}", 50 * view + 9 * k, "<frame>") for k in range(5)] for view in (1, 2, 3)]
    (photo, render), shown = map(address, views[1][:2]), r"src='(data:[^']*)'"
    verdicts = [Verdict("Path", "All 3 images", "No image is <lost>."), Verdict("Next", "Try", "Smaller:", "run --x")]
    page = build_report(
        "t", "s", METRICS, {"held-out views": [STRIPS["held-out views"][0], *views]}, PLOTS,
        '{"a": 1}', ["careful"], judged=verdicts, commands=[("View it:", "sigmasplat view r")],
    )  # fmt: skip
    opened = page[page.index("<main>") : page.index("<details")]
    assert re.findall(shown, opened) == [render, photo] and render != photo, "the map, then the photo"
    places = [opened.index(words) for words in ("careful", render, "All 3 images", "run --x", "sigmasplat view")]
    assert places == sorted(places) and "No image is &lt;lost&gt;." in opened and "&lt;frame&gt;" in opened
    folded = page[page.index("<details") :]
    titles = re.findall(r"<details class=part><summary><h2>(.*?)</h2>", folded)
    assert titles == ["Trajectory", "Views", "Scores", "Settings (config.json)"]
    assert page.count("<h2>") == len(titles)
    page = build_report("t", "s", METRICS, plan=[plain("What is there", 7)])
    drawn = address(plain("What is there", 7))
    assert drawn in page[: page.index("<details")], "without a view the floor plan is shown"
