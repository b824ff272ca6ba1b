"""Stereo pairs become RGB-D: lists, depth errors against exact depth, and the scene's scale."""

import json
from dataclasses import replace

import ablation_runs as ablation
import numpy as np
import pytest
from ablation_runs import run_job

from command_line import exit_code
from layouts import save, save_text, tum_line
from sigmasplat.config.find_preset import preset
from sigmasplat.config.scale import for_scene, scaled
from sigmasplat.config.text import override
from sigmasplat.env import opencv
from sigmasplat.errors import SourceError
from sigmasplat.input.images import read_color
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.batch.make_run import make_run
from sigmasplat.plugins.checks.recording import inspect_source
from sigmasplat.plugins.sources import open_source, stereo
from sigmasplat.run.scene import open_scene
from sigmasplat.run.terminal import Screen
from sigmasplat.run_folder.runs import RunFolder

BASELINE_M = 0.1
ROOM = open_source("synthetic:frames=40,stereo=10")
LEFT = [np.rint(ROOM.frame(i).color * 255).astype(np.uint8) for i in (0, 1)]
RIGHT = [ROOM.right_image(i) for i in (0, 1)]


def tum_like(folder):
    c = ROOM.camera
    for name, part, images in (("rgb.txt", "rgb", LEFT), ("right.txt", "right", RIGHT)):
        for i, image in enumerate(images):
            save(folder / part / f"{i}.png", image)
        save_text(folder / name, "".join(f"{i / 10} {part}/{i}.png\n" for i in range(2)))
    save_text(folder / "groundtruth.txt", "".join(tum_line(i / 10, ROOM.truth().T_world_camera[i]) for i in range(2)))
    fields = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "baseline_m": BASELINE_M}
    save_text(folder / "calibration.json", json.dumps(fields))
    return folder


def test_depth_is_that_of_the_left_image(tmp_path):
    source = open_source(tum_like(tmp_path))
    depth_m, exact_m = source.frame(1).depth_m, ROOM.exact_depth_of(1)
    read = depth_m > 0
    assert len(source) == 2 and source.timestamp_s(1) == pytest.approx(0.1)
    assert read.mean() > 0.3 and source.computed_depth
    assert np.median(np.abs(depth_m - exact_m)[read] / exact_m[read]) < 0.03
    np.testing.assert_allclose(source.truth().T_world_camera, ROOM.truth().T_world_camera[:2], atol=1e-5)


def test_a_frame_reads_each_image_once(tmp_path, monkeypatch):
    source, read = open_source(tum_like(tmp_path)), []
    monkeypatch.setattr(stereo.api, "read_color", lambda path: read.append(path.parent.name) or read_color(path))
    source.frame(1)
    assert sorted(read) == ["rgb", "right"]


def test_standard_deviations_cover_the_errors_on_exact_depth():
    room = open_source("synthetic:frames=40,stereo=10,noise=1")
    ratios = []
    for i in (3, 23):
        left = np.rint(room.frame(i).color * 255.0).astype(np.uint8)
        depth_m, std_m = room._matcher.depth_and_std_m(left, room.right_image(i))
        read = depth_m > 0
        assert np.array_equal(read, std_m > 0) and (std_m <= 0.05 * depth_m + 1e-6).all()
        ratios.append((np.abs(depth_m - room.exact_depth_of(i)) / np.where(read, std_m, 1))[read])
    found = np.concatenate(ratios)
    assert abs((found < 1).mean() - 0.683) < 0.08 and (found < 1.96).mean() > 0.85


def test_depth_does_not_depend_on_the_number_of_threads():
    cv2, before = opencv(), opencv().getNumThreads()
    found = []
    try:
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            found.append(ROOM.frame(5).depth_m)
    finally:
        cv2.setNumThreads(before)
    assert np.array_equal(*found)


def test_a_pair_without_baseline_or_with_a_lens_is_refused(tmp_path):
    folder = tum_like(tmp_path)
    fields = json.loads((folder / "calibration.json").read_text())
    for change, words in (
        ({"baseline_m": None}, "baseline_m"),
        ({"baseline_m": -0.1}, "it must be above 0"),
        ({"distortion": [-0.1, 0.02, 0.001, -0.001, 0.0]}, "must be rectified"),
    ):
        changed = {name: value for name, value in (fields | change).items() if value is not None}
        save_text(folder / "calibration.json", json.dumps(changed))
        with pytest.raises(SourceError, match=words):
            open_source(folder)


def test_images_of_another_size_are_refused(tmp_path):
    folder = tum_like(tmp_path)
    save(folder / "right" / "1.png", RIGHT[1][:-2])
    source = open_source(folder)
    with pytest.raises(SourceError, match="but the calibration is for"):
        source.frame(1)


def deep(folder):
    fields = json.loads((tum_like(folder) / "calibration.json").read_text())
    save_text(folder / "calibration.json", json.dumps(fields | {"baseline_m": 1.0}))  # all depths are 10 times larger
    return folder


def test_a_deep_scene_has_a_scale_and_no_warning_about_its_depth(tmp_path):
    folder = deep(tmp_path)
    source = open_source(folder)
    assert source.scene_scale > 5
    warnings = inspect_source(folder, preset("sigma").input).warnings
    assert not any("scale" in text or "registered" in text for text in warnings)


def test_settings_that_are_lengths_follow_the_scale_of_the_scene():
    config = preset("sigma")
    assert scaled(config, 1.0) == config and for_scene(config, 1.0, None) == config
    large = for_scene(config, 5.0, 0.001)
    assert large.input.max_depth_m == 5 * config.input.max_depth_m
    assert large.submaps.distance_m == 5 * config.submaps.distance_m
    assert large.mapping.weight_mean_depth == config.mapping.weight_mean_depth / 5
    assert (large.render.scene_scale, large.render.depth_noise_per_m) == (5.0, 0.001)


def test_gray_counts_as_much_as_depth_of_a_stereo_pair():
    config, name = preset("sigma"), "tracking.align_weight_color"
    assert config.tracking.align_weight_color < 0.5
    assert for_scene(config, 1.0, 0.006).tracking.align_weight_color == 0.5
    for asked in (0.7, 0.2):
        own = override(config, {name: str(asked)})
        assert for_scene(own, 1.0, 0.006).tracking.align_weight_color == max(asked, 0.5)
        assert for_scene(own, 1.0, 0.006, [name]).tracking.align_weight_color == asked
    for noise, predicted in ((None, False), (0.1, True)):
        assert for_scene(config, 1.0, noise, predicted_depth=predicted).tracking.align_weight_color < 0.5


def test_depth_of_a_stereo_pair_is_read_with_its_colour():
    """The times measured on a drive were 12 ms of late depth, and its ATE rose from 14 to 24 cm."""
    config, measured = preset("sigma"), "0.01,0.02,0.03,0.001,0.001,0.001"
    assert for_scene(config, 1.0, 0.006).input.calibrate == "off"
    assert for_scene(config, 1.0, None).input.calibrate == "auto"
    assert for_scene(config, 1.0, 0.006, ["input.calibrate"]).input.calibrate == "auto"
    assert for_scene(override(config, {"input.calibrate": measured}), 1.0, 0.006).input.calibrate == measured


SHORT = {
    "input.width": "64", "input.limit": "1", "final.iterations": "0", "mapping.iterations": "1",
    "mapping.first_iterations": "2",
}  # fmt: skip


def test_every_caller_gets_the_settings_of_the_scene_and_keeps_those_that_are_given(tmp_path, monkeypatch):
    folder, usual = deep(tmp_path / "deep"), override(preset("sigma"), SHORT | {"render.near_m": "0.05"})
    source, config = open_scene(folder, usual, ["render.near_m"])
    assert config.render.scene_scale == source.scene_scale and config.render.near_m == 0.05
    assert config.submaps.distance_m == source.scene_scale * usual.submaps.distance_m
    assert open_scene("synthetic:frames=2,width=64,height=48", usual)[1] == usual.changed(input={"sensor": "rendered"})

    def no_scores(run, *_, **__):
        run.write_metrics({})
        return {"failure": ""}

    monkeypatch.setattr("sigmasplat.plugins.batch.make_run.evaluate", no_scores)
    monkeypatch.setattr("sigmasplat.plugins.evaluation.evaluate.evaluate", no_scores)
    given = ("render.near_m",)
    run_job(ablation.Job("deep", str(folder), "none", 0, usual, given), tmp_path / "ablation", Screen())
    table = Job("one", (str(folder),), usual, given=given)
    make_run(Job.from_json(table.to_json()), tmp_path / "one", None, 60.0)
    assert table.finished_in(tmp_path / "one") and not replace(table, given=()).finished_in(tmp_path / "one")
    assert RunFolder(tmp_path / "ablation").config() == RunFolder(tmp_path / "one").config() == config
    words = [word for name, value in SHORT.items() for word in ("--set", f"{name}={value}")]
    out = ("--out", str(tmp_path / "onto"))
    assert exit_code("run", "synthetic:frames=40", "--onto", str(tmp_path / "one"), *out, "--no-eval", *words) == 0
    onto = RunFolder(tmp_path / "onto").config()
    assert onto.input.max_depth_m == config.input.max_depth_m
    assert onto.submaps.distance_m == config.submaps.distance_m and onto.render.depth_noise_per_m == 0.003
