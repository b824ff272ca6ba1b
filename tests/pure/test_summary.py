"""The sentences of the report follow from the figures, and its commands can be run."""

import shlex
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override, split_settings
from sigmasplat.plugins.evaluation.failure import rerun_command
from sigmasplat.plugins.evaluation.report.advice import advice, next_commands
from sigmasplat.plugins.evaluation.report.charts import trajectory_charts
from sigmasplat.plugins.evaluation.report.page import write_page
from sigmasplat.plugins.evaluation.report.summary import (
    result_sentence,
    verdicts,
)
from sigmasplat.plugins.evaluation.report.tables import score_tables, state_rows
from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder

GOOD = {
    "source": "kitchen", "status": "complete", "frames": 500, "splats": 1000, "frames_per_s": 13.5, "lost": 0,
    "ate": {"rmse_m": 0.026, "max_m": 0.09}, "ate_odometry": {"rmse_m": 0.035},
    "held_out": {"psnr_db": 31.0, "depth_l1_m": 0.019, "depth_coverage": 0.999},
    "training": {"psnr_db": 31.5}, "uncertainty": {"spearman": 0.55}, "submaps": 1, "loops": {"accepted": 0},
}  # fmt: skip
SETTINGS = preset("sigma").to_dict()
RUN = "sigmasplat run data/k"


def summary(**changes) -> str:
    """Return the verdicts in one text."""
    return " ".join(words for verdict in verdicts(GOOD | changes, (), []) for words in verdict)


def test_a_good_run_in_words() -> None:
    text = summary()
    for words in (
        "All 500 images have a pose", "never lost", "path is 2.6 cm",
        "error is 9.0 cm", "Without loop closure the RMS error is 3.5 cm",
        "Very close to the camera images: 31.0 dB PSNR", "that the map was not made from",
        "1.9 cm on average: good",
    ):  # fmt: skip
        assert words in text, words


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"lost": 52}, "lost on 52 of 500 images"),
        ({"lost": 2, "lost_frames": [8, 9]}, "2 of 500 images have no pose (8–9)"),
        (
            {"relocalised": 1, "relocalised_frames": [57]},
            "had to find its place in the map again at image 57",
        ),
        ({"apart": 41, "components": [{}]}, "41 images are in a map of their own"),
        ({"apart": 41, "components": [{}, {}]}, "41 images are in 2 maps of their own"),
        ({"failures": {"silent": 7}}, "7 poses are off by more than 10 cm"),
        ({"ate": None}, "no ground truth"),
        ({"onto": "/first", "believed": 500}, "It continues the map of /first: poses are in the world of that run"),
        ({"onto": "/first", "believed": 0}, "never recognised in the map of /first"),
        ({"held_out": {"psnr_db": 17.0}}, "Poor: 17.0 dB PSNR"),
        ({"held_out": None}, "because none was held back"),
        (
            {"pose_covariance": {"window_frames": 50, "windows": {"position_coverage_90": 0.934}}},
            "over 50 frames should be within the covariance of the poses: measured 93 %. It has the right size.",
        ),
        (
            {"pose_covariance": {"window_frames": 50, "windows": {"position_coverage_90": 0.0, "position_k": 124.7}}},
            "measured 0 %. It is too small, in this recording by a factor of 124.7.",
        ),
        ({"pose_covariance": {"window_frames": 50, "windows": {"position_coverage_90": 1.0}}}, "It is too large."),
        (
            {
                "pose_covariance": {
                    "window_frames": 50,
                    "truth_error_m": 0.004,
                    "truth_error_deg": 0.3,
                    "windows": {"position_coverage_90": 0.2, "position_coverage_90_with_truth": 0.61},
                }
            },
            "It is too small. With the own error of the true path, 4 mm and 0.3° a pose, 61 % are within.",
        ),
        ({"lost": 2, "relocalised_frames": [9]}, "which have no pose. It found its place in the map again at image 9."),
        (
            {"held_out": {"psnr_db": 24.0, "depth_l1_m": 0.01, "depth_coverage": 0.7}},
            "30 % of the depth readings",
        ),
        ({"held_out": {"depth_l1_m": 0.009, "depth_coverage": 1.0}}, "0.9 cm on average: very accurate."),
        ({"held_out": {"depth_l1_m": 0.031, "depth_coverage": 1.0}}, "3.1 cm on average: coarse."),
        ({"ate_odometry": {"rmse_m": 0.020}}, "Without loop closure the RMS error is 2.0 cm"),
    ],
)
def test_the_summary_names_what_is_wrong(changes: dict, words: str) -> None:
    assert words in summary(**changes)


def test_an_image_that_was_relocalised_was_not_never_lost() -> None:
    assert "never lost" not in summary(relocalised=1, relocalised_frames=[57])
    assert "never lost" not in summary(lost=3, relocalised=1, relocalised_frames=[57])


def test_the_verdicts_say_where_the_path_is_not_sure_how_good_the_map_is_and_what_to_do() -> None:
    path, of_map, todo = verdicts(GOOD, [3, 4, 9], [("Blurred:", "sigmasplat run x"), ("Slow:", "")])
    assert (path.about, path.words) == ("Path", "All 500 images have a pose, 3 of them doubtful")
    assert "Probably off by more than 5 cm: images 3–4, 9." in path.meaning
    assert (of_map.about, of_map.words) == ("Map", "Very close to the camera images: 31.0 dB PSNR")
    assert "1.9 cm on average: good" in of_map.meaning
    assert (todo.about, todo.meaning, todo.command) == ("Next", "Blurred:", "sigmasplat run x")
    assert "nothing to repair" in verdicts(GOOD, [], [])[2].meaning
    assert verdicts({"frames": 1}, [], [])[1].words == "Not compared with images"


def test_the_result_is_one_sentence() -> None:
    sentence = result_sentence(GOOD)
    assert sentence == (
        "All 500 images have a pose, the RMS error of the path is 2.6 cm; "
        "the map is very close to the camera images: 31.0 dB PSNR."
    )
    apart = result_sentence(GOOD | {"ate": None, "lost": 1, "lost_frames": [9], "apart": 2, "apart_frames": [4, 5]})
    assert apart.startswith("3 of 500 images have no pose (4–5, 9), of which 2 are in components/; the map is")


def test_loops_with_hardly_any_effect_are_left_out() -> None:
    for off_m, without_m in [(0.026, 0.028), (0.002, 0.0028), (0.026, None)]:
        assert "Without loop closure" not in summary(ate={"rmse_m": off_m}, ate_odometry={"rmse_m": without_m})


def test_unknown_figures_are_left_out() -> None:
    found = {"source": "x", "frames": 1, "splats": 0, "lost": 0}
    text = " ".join([*verdicts(found, (), [])[0][1:], verdicts(found, (), [])[1].meaning])
    assert "dB" not in text and " V " not in text and "None" not in text


@pytest.mark.parametrize(
    "changes, settings, words, command",
    [
        ({"lost": 3}, {"input.stride": "3"}, "one image in 3", "--stride 1"),
        ({"lost": 3}, {}, "record that part again", "mapping.every=2"),
        ({"apart": 2, "apart_frames": [7, 8]}, {}, "Images 7–8 are in separate maps", ""),
        ({"held_out": {"psnr_db": 22.0}}, {}, "320 pixels wide", "input.width=640"),
        ({"held_out": {"psnr_db": 31.0, "depth_coverage": 0.6}}, {}, "40 % of the depth readings", ""),
        ({"frames_per_s": 1.2}, {}, "slow: 1.2 images per second", "input.width=240"),
        ({"submaps": 5}, {}, "End a scan where it started", ""),
        ({"calibration": None}, {"uncertainty.probes": "0"}, "kept no probe views", "uncertainty.probes=4"),
        ({"calibration": None}, {"uncertainty.probes": "2"}, "did not make its final map", RUN),
    ],
)
def test_commands_of_the_advice_can_be_run(changes: dict, settings: dict, words: str, command: str) -> None:
    config = override(preset("sigma"), settings)
    found = [item for item in advice(GOOD | changes, RUN, config.to_dict()) if words in item[0]]
    assert len(found) == 1 and command in found[0][1]
    given = shlex.split(found[0][1])
    override(config, split_settings(value for flag, value in pairwise(given) if flag == "--set"))


def test_after_a_good_run_the_advice_is_to_view_and_to_share() -> None:
    assert advice(GOOD, RUN, SETTINGS) == []
    commands = [shlex.split(command) for _, command in next_commands("runs/my k")]
    assert [(words[1], words[2]) for words in commands] == [
        ("view", "runs/my k"), ("share", "runs/my k"), ("mesh", "runs/my k"),
    ]  # fmt: skip


def test_the_command_to_run_again_keeps_the_settings_of_the_run() -> None:
    config = override(
        preset("sigma"), {"input.fx": "570", "input.register_depth": "on", "input.limit": "7", "seed": "3"}
    )
    again = rerun_command(config, {"source_path": "data/my room"})
    words = shlex.split(again)
    assert words[:3] == ["sigmasplat", "run", "data/my room"]
    made = override(preset("sigma"), split_settings(value for flag, value in pairwise(words) if flag == "--set"))
    assert made == config
    assert shlex.split(rerun_command(preset("varsplat-fast"), {}))[3:] == ["--preset", "varsplat-fast"]
    assert rerun_command(replace(config, name="mine"), {}) == "sigmasplat run PATH"


def test_tables_count_the_states() -> None:
    found = GOOD | {"lost": 2, "lost_frames": [3, 4], "relocalised_frames": [5], "apart": 1, "apart_frames": [9]}
    rows = {row[0]: row[1:] for row in state_rows(found)}
    assert [rows[state][0] for state in ("tracked", "relocalised", "lost", "apart")] == ["496", "1", "2", "1"]
    assert rows["lost"][2] == "3–4"
    assert len(state_rows(GOOD)) == 2


def test_tables_show_coverage_or_the_advice_that_there_are_no_predicted_errors() -> None:
    known = {
        "calibration": {"probes": 7, "color": {"residual": 1.5}, "depth": {"residual": 0.25, "sensor": 3e-6}},
        "predictive": {"views": 9, "color": {"coverage_68": 0.7}, "depth": {"coverage_68": 0.61, "z_68": 1.524}},
    }
    known = GOOD | known | {"uncertainty": None}
    (rows,) = [rows for title, rows in score_tables(known) if title.startswith("Predicted errors")]
    assert ["Within 1 standard deviation, % (ideal 68)", "70.0", "61.0"] in rows
    assert ["Factor that makes it 68 % (ideal 1)", "–", "1.52"] in rows
    found = advice(GOOD | {"calibration": None}, RUN, SETTINGS)
    assert "no predicted errors" in " ".join(words for words, _ in found)
    assert not advice(GOOD, RUN, SETTINGS), "files of older versions do not say"


def test_the_page_is_one_file(tmp_path) -> None:
    run = RunFolder.create(tmp_path / "run", replace(BASE, name="made-up"), "kitchen")
    run.note(status="complete", source_path="data/kitchen")
    write_page(
        run,
        GOOD | {"uncertainty": None},
        {"held-out": [[ViewPanel("input", np.zeros((30, 40, 3), np.uint8))]]},
        {"trajectory": (trajectory_charts(np.eye(3), None), "a path")},
        ["careful"],
    )
    page = (run.path / "report.html").read_text()
    for words in ("All 500 images have a pose", "careful", "sigmasplat view", "Settings (config.json)"):
        assert words in page
    assert page.count("data:image/webp;base64,") == 2 and page.count("<svg") == 2
    assert "images/" not in page and "http" not in page.replace("http://www.w3.org/2000/svg", "")
