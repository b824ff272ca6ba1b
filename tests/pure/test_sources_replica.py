"""Replica layout: images by number, 4×4 poses, the camera from cam_params.json or as published."""

import json

import numpy as np
import pytest
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources import open_source

PARAMS = {"camera": {"w": 20, "h": 12, "fx": 15.0, "fy": 16.0, "cx": 9.5, "cy": 5.5, "scale": 6553.5}}


@pytest.fixture
def replica(tmp_path):
    folder = tmp_path / "room0"
    (folder / "results").mkdir(parents=True)
    for i in range(3):
        Image.fromarray(np.full((12, 20, 3), 60 * i, np.uint8)).save(folder / f"results/frame{i:06d}.jpg")
        Image.fromarray(np.full((12, 20), 13107, np.uint16)).save(folder / f"results/depth{i:06d}.png")
    rows = []
    for i in range(3):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [i, 2, 3]
        rows.append(" ".join(str(v) for v in T.ravel()))
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    (tmp_path / "cam_params.json").write_text(json.dumps(PARAMS))
    return folder


def test_reading(replica):
    source = open_source(replica)
    assert (len(source), source.name) == (3, "room0")
    assert source.camera == Camera(20, 12, 15.0, 16.0, 9.5, 5.5)
    frames = list(source)
    assert [f.timestamp_s for f in frames] == pytest.approx([0, 1 / 30, 2 / 30])
    assert frames[1].depth_m == pytest.approx(np.full((12, 20), 2.0)) and frames[1].color.mean() == pytest.approx(
        60 / 255, abs=0.01
    )
    truth = source.truth().T_world_camera
    assert truth[2, :3, 3].tolist() == [2, 2, 3] and truth[2, 1, 0] == 1.0
    assert source.truth().error_rms == (0.0, 0.0)


def test_the_camera_file_in_the_folder_overrides_the_parents(replica):
    own = {"camera": PARAMS["camera"] | {"fx": 99.0, "scale": 13107.0}}
    (replica / "cam_params.json").write_text(json.dumps(own))
    source = open_source(replica)
    assert source.camera.fx == 99.0 and source.frame(0).depth_m[0, 0] == 1.0


def test_without_camera_file_the_published_camera_is_used_and_the_size_must_match(replica):
    (replica.parent / "cam_params.json").unlink()
    with pytest.raises(SourceError, match="20×12 but the calibration is for 1200×680"):
        open_source(replica)


def test_a_colour_image_without_its_depth_is_left_out(replica):
    (replica / "results/depth000001.png").unlink()
    source = open_source(replica)
    assert [f.color.mean() > 0.3 for f in source] == [False, True]
    assert len(source.skipped) == 1 and "frame000001.jpg" in source.skipped[0]
    assert source.truth().T_world_camera[:, 0, 3].tolist() == [0, 2], "poses stay with their images"


def test_rgb_only_download(replica):
    for path in (replica / "results").glob("depth*"):
        path.unlink()
    with pytest.raises(SourceError, match=r"no depth images in .*results/depth\*\.png.*RGB-only"):
        open_source(replica)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("nan " * 16, r"traj\.txt:2: not finite"),
        ("2 0 0 0  0 2 0 0  0 0 2 0  0 0 0 1", r"traj\.txt:2: not a rigid camera-to-world pose"),
        ("1 2 3", r"traj\.txt:2: expected a 4×4 matrix by rows, found 3 values"),
    ],
)
def test_a_bad_pose_is_named_by_its_line(replica, line, match):
    rows = (replica / "traj.txt").read_text().splitlines()
    rows[1] = line
    (replica / "traj.txt").write_text("\n".join(rows))
    with pytest.raises(SourceError, match=match):
        open_source(replica)


def test_fewer_poses_than_images(replica):
    (replica / "traj.txt").write_text((replica / "traj.txt").read_text().splitlines()[0])
    with pytest.raises(SourceError, match="1 poses, but the last image has number 2"):
        open_source(replica)


def test_the_true_surface_is_found_beside_the_sequence_or_in_it(replica):
    assert open_source(replica).true_surface_file() is None
    within, beside = replica / "room0_mesh.ply", replica.parent / "room0_mesh.ply"
    within.touch()
    assert open_source(replica).true_surface_file() == within
    beside.touch()
    assert open_source(replica).true_surface_file() == open_source(replica, limit=2).true_surface_file() == beside
