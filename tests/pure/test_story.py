"""What the report says in words follows from the figures, and its commands can be given."""

import json
import shlex
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
from PIL import Image

from sigmasplat.config import Config
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import RunError
from sigmasplat.floorplan.rescan import Region
from sigmasplat.io.runs import RunFolder
from sigmasplat.presets import preset
from sigmasplat.report.page import _again, data_uri, write_page
from sigmasplat.report.summary import advice, summary_sentences, unsure

GOOD = {
    "source": "kitchen", "status": "complete", "frames": 500, "splats": 1000, "frames_per_s": 13.5, "lost": 0,
    "ate": {"rmse_m": 0.026, "max_m": 0.09}, "ate_odometry": {"rmse_m": 0.035},
    "held_out": {"psnr_db": 31.0, "depth_l1_m": 0.019, "depth_coverage": 0.999},
    "training": {"psnr_db": 31.5}, "uncertainty": {"spearman": 0.55}, "submaps": 1, "loops": {"accepted": 0},
}  # fmt: skip
SETTINGS = preset("sigma").to_dict()
RUN = "sigmasplat run data/k"


def said(**changes) -> str:
    return " ".join(summary_sentences(GOOD | changes, "a laptop"))


def test_a_good_run_in_words() -> None:
    text = said()
    for words in (
        "500 colour + depth images of kitchen", "13.5 images a second on a laptop", "followed all the way",
        "off by 2.6 cm", "at worst by 9.0 cm", "Without its closed loops it would be off by 3.5 cm",
        "31.0 dB PSNR: hard to tell", "1.9 cm from the measured ones: good", "wrong ones well",
    ):  # fmt: skip
        assert words in text, words


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"lost": 52}, "lost on 52 of 500 images"),
        ({"ate": None}, "No true path is known"),
        ({"status": "interrupted"}, "The run is interrupted"),
        ({"held_out": {"psnr_db": 17.0}}, "17.0 dB PSNR: poor"),
        (
            {"held_out": {"psnr_db": 24.0, "depth_l1_m": 0.01, "depth_coverage": 0.7}},
            "30 % of what the",
        ),
        ({"held_out": {"depth_l1_m": 0.009, "depth_coverage": 1.0}}, "0.9 cm from the measured ones: close."),
        ({"held_out": {"depth_l1_m": 0.031, "depth_coverage": 1.0}}, "3.1 cm from the measured ones: coarse."),
        ({"ate_odometry": {"rmse_m": 0.020}}, "Without its closed loops it would be off by 2.0 cm"),
        ({"uncertainty": {"spearman": 0.02}}, "hardly"),
    ],
)
def test_what_is_wrong_is_said(changes: dict, words: str) -> None:
    assert words in said(**changes)


def test_loops_that_moved_next_to_nothing_are_not_told() -> None:
    for off_m, without_m in [(0.026, 0.028), (0.002, 0.0028), (0.026, None)]:
        assert "Without its closed loops" not in said(ate={"rmse_m": off_m}, ate_odometry={"rmse_m": without_m})


def test_nothing_is_said_of_what_is_not_known() -> None:
    text = " ".join(summary_sentences({"source": "x", "frames": 1, "splats": 0, "lost": 0}))
    assert "dB" not in text and "V tells" not in text and "None" not in text


@pytest.mark.parametrize(
    "changes, settings, words, command",
    [
        ({"lost": 3}, {"input.stride": "3"}, "every 3th image", "--stride 1"),
        ({"lost": 3}, {}, "record that part again", "mapping.every=2"),
        ({"training": {"psnr_db": 36.0}}, {}, "5.0 dB better", "mapping.every=2"),
        ({"held_out": {"psnr_db": 22.0}}, {}, "320 pixels wide", "input.width=640"),
        ({"held_out": {"psnr_db": 31.0, "depth_coverage": 0.6}}, {}, "40 % of what was measured", ""),
        ({"frames_per_s": 1.2}, {}, "1.2 images a second is slow", "input.width=240"),
        ({"frames_per_s": 1.2, "finish_s": 400.0}, {}, "1.2 images a second is slow", "input.width=240"),
        ({"frames_per_s": 1.2, "finish_s": 430.0}, {}, "took 430 s after 417 s of frames", "final.iterations=750"),
        ({"finish_s": 80.0}, {"final.iterations": "300"}, "took 80 s after 37 s of frames", "final.iterations=150"),
        ({"submaps": 5}, {}, "end a scan where it began", ""),
    ],
)
def test_advice_names_a_command_that_can_be_given(changes: dict, settings: dict, words: str, command: str) -> None:
    config = override(preset("sigma"), settings)
    found = [item for item in advice(GOOD | changes, "runs/k", RUN, config.to_dict()) if words in item[0]]
    assert len(found) == 1 and command in found[0][1]
    given = shlex.split(found[0][1])
    override(config, split_settings(value for flag, value in pairwise(given) if flag == "--set"))


def test_a_good_run_is_only_told_what_to_do_with_it() -> None:
    assert [command.split()[1] for _, command in advice(GOOD, "runs/k", RUN, SETTINGS)] == [
        "view",
        "mesh",
    ]


def test_the_command_that_is_advised_keeps_what_the_run_was_made_with() -> None:
    config = override(
        preset("sigma"), {"input.fx": "570", "input.register_depth": "on", "input.limit": "7", "seed": "3"}
    )
    again = _again(config, {"source_path": "data/my room"})
    words = shlex.split(again)
    assert words[:3] == ["sigmasplat", "run", "data/my room"]
    made = override(preset("sigma"), split_settings(value for flag, value in pairwise(words) if flag == "--set"))
    assert made == config
    assert shlex.split(_again(preset("varsplat-fast"), {}))[3:] == ["--preset", "varsplat-fast"]
    assert _again(replace(config, name="mine"), {}) == "sigmasplat run PATH"


def test_a_final_map_that_was_quick_or_had_no_steps_is_not_shortened() -> None:
    for finish_s, iterations in [(50.0, "1500"), (900.0, "0")]:
        config = override(preset("sigma"), {"final.iterations": iterations})
        found = advice(GOOD | {"finish_s": finish_s}, "runs/k", "data/k", config.to_dict())
        assert [command.split()[1] for _, command in found] == ["view", "mesh"]


def test_where_it_was_unsure() -> None:
    plan = SimpleNamespace(regions=[Region((0, 0), 0.3, area, why, "") for area, why in
                                    ((2.0, "unseen"), (1.5, "unseen"), (0.4, "unsure"))])  # fmt: skip
    assert unsure(GOOD, None) == []
    (sentence,) = unsure(GOOD, plan)
    assert "2 never seen (3.5 m²), 1 mapped, but unsure (0.4 m²)" in sentence
    lost = unsure(GOOD | {"lost_frames": [3, 4, 5, 9]}, SimpleNamespace(regions=[]))
    assert len(lost) == 1 and "3–5, 9" in lost[0]


def test_the_page_is_one_file(tmp_path) -> None:
    run = RunFolder.create(tmp_path / "run", replace(Config(), name="made-up"), "kitchen")
    run.note(status="complete", source_path="data/kitchen")
    for name in ("view-held-out-000001", "trajectory-light", "trajectory-dark"):
        run.write_image(f"{name}.png", Image.new("RGB", (40, 30), (200, 60, 20)))
    run.write_profile({"blend": 6.0, "io": 2.0})
    write_page(
        run,
        GOOD | {"uncertainty": None},
        {"held-out": ["images/view-held-out-000001.png"]},
        {"trajectory": "a path"},
        ["careful"],
    )
    page = (run.path / "report.html").read_text()
    for words in ("In short", "What to try next", "careful", "sigmasplat view", "75", "config.json, as used"):
        assert words in page
    assert page.count("data:image/webp;base64,") == 3 and "images/" not in page and "http" not in page


def test_a_picture_that_is_missing_is_named(tmp_path) -> None:
    with pytest.raises(RunError, match=r"view\.png"):
        data_uri(tmp_path / "view.png")
    assert json.dumps(SETTINGS)
