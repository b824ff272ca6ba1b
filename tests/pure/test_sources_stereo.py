"""Stereo pairs become RGB-D: every layout, rectification, depth errors against exact depth, and the scene's scale."""

import json
from dataclasses import replace

import ablation_runs as ablation
import numpy as np
import pytest
from ablation_runs import run_job

from bag_recordings import Recorder
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
from sigmasplat.plugins.sources.stereo_matching import StereoCameras, StereoRectification
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


def kitti(folder):
    c = ROOM.camera
    for part, images in (("image_2", LEFT), ("image_3", RIGHT)):
        for i, image in enumerate(images):
            save(folder / part / f"{i:06d}.png", image)
    lines = [f"P{k}: {c.fx} 0 {c.cx} {-c.fx * x} 0 {c.fy} {c.cy} 0 0 0 1 0\n" for k, x in ((2, 0.0), (3, BASELINE_M))]
    save_text(folder / "calib.txt", "".join(lines))
    save_text(folder / "times.txt", "0\n0.1\n")
    rows = [" ".join(map(str, T[:3].ravel())) + "\n" for T in ROOM.truth().T_world_camera[:2]]
    save_text(folder / "poses.txt", "".join(rows))
    return folder


def euroc(folder):
    c = ROOM.camera
    for name, images, x in (("cam0", LEFT, 0.0), ("cam1", RIGHT, BASELINE_M)):
        for i, image in enumerate(images):
            save(folder / "mav0" / name / "data" / f"{i * 10**8}.png", image)
        lines = "".join(f"{i * 10**8},{i * 10**8}.png\n" for i in range(2))
        save_text(folder / "mav0" / name / "data.csv", "#timestamp [ns],filename\n" + lines)
        T = f"1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1"
        save_text(
            folder / "mav0" / name / "sensor.yaml",
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{T}]\nresolution: [{c.width}, {c.height}]\n"
            f"intrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}] #fu, fv, cu, cv\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n",
        )
    return folder


@pytest.mark.parametrize("layout", [tum_like, kitti, euroc], ids=lambda layout: layout.__name__)
def test_depth_of_every_layout_is_that_of_the_left_image(layout, tmp_path):
    source = open_source(layout(tmp_path))
    depth_m, exact_m = source.frame(1).depth_m, ROOM.exact_depth_of(1)
    read = depth_m > 0
    assert len(source) == 2 and source.timestamp_s(1) == pytest.approx(0.1)
    assert read.mean() > 0.3 and source.computed_depth
    assert np.median(np.abs(depth_m - exact_m)[read] / exact_m[read]) < 0.03
    if layout is not euroc:
        np.testing.assert_allclose(source.truth().T_world_camera, ROOM.truth().T_world_camera[:2], atol=1e-5)


def test_a_frame_reads_each_image_once(tmp_path, monkeypatch):
    source, read = open_source(tum_like(tmp_path)), []
    monkeypatch.setattr(stereo, "read_color", lambda path: read.append(path.parent.name) or read_color(path))
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


def test_rectification_aligns_the_rows_of_a_turned_and_distorted_pair():
    camera = ROOM.camera
    turn = opencv().Rodrigues(np.array([0.02, -0.03, 0.015]))[0]
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = turn, turn @ [-0.1, 0.004, -0.002]
    lens = (-0.1, 0.02, 0.001, -0.001, 0.0)
    pair = StereoCameras(camera, replace(camera, fx=camera.fx * 1.02), T_right_left, lens, lens)
    found = StereoRectification.of(pair)
    assert found.baseline_m == pytest.approx(np.linalg.norm([0.1, 0.004, 0.002]), rel=1e-6)
    points = np.array([[0.2, 0.1, 2.0], [-0.5, 0.3, 3.0], [0.1, -0.4, 1.5]])  # in the recorded left camera
    rectified = points @ found.T_left_rectified[:3, :3]
    column, row = (found.camera.fx * rectified[:, 0] / rectified[:, 2] + found.camera.cx,
                   found.camera.fy * rectified[:, 1] / rectified[:, 2] + found.camera.cy)  # fmt: skip
    disparity = found.camera.fx * found.baseline_m / rectified[:, 2]
    in_right = (points @ T_right_left[:3, :3].T) + T_right_left[:3, 3]
    K = np.array([[pair.right.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    seen = opencv().projectPoints(in_right, np.zeros(3), np.zeros(3), K, np.array(lens))[0][:, 0]
    for u, v, d, recorded in zip(column, row, disparity, seen, strict=True):
        at = [opencv().remap(plane, np.float32([[u - d]]), np.float32([[v]]), 1)[0, 0] for plane in found.maps[1]]
        np.testing.assert_allclose(at, recorded, atol=0.05)


def test_a_pair_without_baseline_or_with_swapped_cameras_is_refused(tmp_path):
    folder = tum_like(tmp_path)
    fields = json.loads((folder / "calibration.json").read_text())
    del fields["baseline_m"]
    save_text(folder / "calibration.json", json.dumps(fields))
    with pytest.raises(SourceError, match="baseline_m"):
        open_source(folder)
    T = np.eye(4)
    T[0, 3] = 0.1
    save_text(folder / "calibration.json", json.dumps(fields | {"T_right_left": T.tolist()}))
    with pytest.raises(SourceError, match="swap"):
        open_source(folder)


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


SHORT = {
    "input.width": "64", "input.limit": "1", "final.iterations": "0", "mapping.iterations": "1",
    "mapping.first_iterations": "2",
}  # fmt: skip


def test_every_caller_gets_the_settings_of_the_scene_and_keeps_those_that_are_given(tmp_path, monkeypatch):
    folder, usual = deep(tmp_path / "deep"), override(preset("sigma"), SHORT | {"render.near_m": "0.05"})
    source, config = open_scene(folder, usual, ["render.near_m"])
    assert config.render.scene_scale == source.scene_scale and config.render.near_m == 0.05
    assert config.submaps.distance_m == source.scene_scale * usual.submaps.distance_m
    assert open_scene("synthetic:frames=2,width=64,height=48", usual)[1] == usual
    no_scores = lambda run, *_, **__: run.write_metrics({})  # noqa: E731
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


def transforms(folder, named):
    c, frames = ROOM.camera, []
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    for i in range(2):
        T = ROOM.truth().T_world_camera[i]
        beside = np.eye(4)
        beside[0, 3] = BASELINE_M
        for part, image, pose in (("left", LEFT[i], T), ("right", RIGHT[i], T @ beside)):
            save(folder / "images" / part / f"{i + 9}.png", image)
            frames.append({"file_path": f"images/{part}/{i + 9}.png", "transform_matrix": (pose @ turn).tolist()})
    if named:
        frames = [
            left | {"right_file_path": right["file_path"]}
            for left, right in zip(frames[::2], frames[1::2], strict=True)
        ]
    camera = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx + 0.5, "cy": c.cy + 0.5, "baseline_m": BASELINE_M}
    save_text(folder / "transforms.json", json.dumps(camera | {"frames": frames}))
    return folder


@pytest.mark.parametrize("named", [True, False])
def test_transforms_with_left_and_right_images_are_a_stereo_pair(named, tmp_path):
    source, same = open_source(transforms(tmp_path / "nerf", named)), open_source(tum_like(tmp_path / "tum"))
    assert len(source) == 2 and source.computed_depth
    assert np.array_equal(source.frame(1).color, same.frame(1).color)
    np.testing.assert_allclose(source.frame(1).depth_m, same.frame(1).depth_m, rtol=1e-4)
    np.testing.assert_allclose(source.truth().T_world_camera, ROOM.truth().T_world_camera[:2], atol=1e-5)


def test_cameras_that_move_apart_are_no_pair(tmp_path):
    folder = transforms(tmp_path, False)
    fields = json.loads((folder / "transforms.json").read_text())
    fields["frames"][-1]["transform_matrix"][0][3] += 0.05
    save_text(folder / "transforms.json", json.dumps(fields))
    with pytest.raises(SourceError, match="move relative to each other"):
        open_source(folder)


def infrared(recorder, baseline_in_info):
    c = ROOM.camera
    for side, images, x_m in ((1, LEFT, 0.0), (2, RIGHT, BASELINE_M)):
        topic, frame = f"/camera/infra{side}/image_rect_raw", f"camera_infra{side}_optical_frame"
        for i, image in enumerate(images):
            gray = opencv().cvtColor(image, opencv().COLOR_RGB2GRAY)
            recorder.image(topic, 1.0 + i / 30, gray, "mono8", frame, late_s=0.001 * side)
        recorder.info(
            f"/camera/infra{side}/camera_info", 1.0, (c.width, c.height), (c.fx - 1, c.fy - 1, c.cx, c.cy), frame
        )
        recorder.messages[-1][3].p[3] = -c.fx * x_m if baseline_in_info else 0.0
    if not baseline_in_info:
        T = np.eye(4)
        T[0, 3] = BASELINE_M
        recorder.transform("/tf_static", 1.0, "camera_infra1_optical_frame", "camera_infra2_optical_frame", T)
    return recorder


@pytest.mark.parametrize("baseline_in_info", [True, False])
def test_the_infrared_pair_of_a_bag_is_a_stereo_pair(baseline_in_info, tmp_path):
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    source = open_source(infrared(Recorder(), baseline_in_info).write(tmp_path / "walk"))
    depth_m, exact_m = source.frame(1).depth_m, ROOM.exact_depth_of(1)
    read = depth_m > 0
    assert len(source) == 2 and source.timestamp_s(1) == pytest.approx(1.0 + 1 / 30) and read.mean() > 0.3
    assert np.median(np.abs(depth_m - exact_m)[read] / exact_m[read]) < 0.03
    colors = source.frame(0).color
    assert np.array_equal(colors[..., 0], colors[..., 2])


def test_depth_of_a_bag_comes_before_its_infrared_pair(tmp_path):
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    recorder, depth_mm = infrared(Recorder(), True), np.full(LEFT[0].shape[:2], 1500, np.uint16)
    for i, image in enumerate(LEFT):
        recorder.image("/camera/color/image_raw", 1.0 + i / 30, image, "rgb8", "color")
        recorder.image("/camera/aligned_depth_to_color/image_raw", 1.0 + i / 30, depth_mm, "16UC1", "color")
    c = ROOM.camera
    recorder.info("/camera/color/camera_info", 1.0, (c.width, c.height), (c.fx, c.fy, c.cx, c.cy), "color")
    path = recorder.write(tmp_path / "walk")
    assert not open_source(path).computed_depth
    names = [f"/camera/infra{side}/image_rect_raw" for side in (1, 2)]
    assert open_source(path, color_topic=names[0], depth_topic=names[1]).computed_depth
