"""TUM layout: reading, calibration, distortion, ground truth, writing; and real recordings if present."""

import json

import numpy as np
import pytest
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.errors import RunError
from sigmasplat.input.calibration import FREIBURG, freiburg_calibration
from sigmasplat.input.recorded import depth_warning
from sigmasplat.input.rectification import Undistortion, distort
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from tum_recording import write_tum
from view_agreement import agreement

FR1 = np.array(FREIBURG["1"].distortion)


def test_a_hand_written_folder_is_read(tiny_tum):
    source = open_source(tiny_tum)
    assert (source.name, len(source), source.skipped) == ("tiny", 4, [])
    assert source.camera == Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    frames = list(source)
    assert [round(f.timestamp_s, 6) for f in frames] == [0.0, 0.1, 0.2, 0.3]
    assert np.array_equal(frames[2].color, (np.asarray(Image.open(tiny_tum / "rgb/2.png")) / 255.0).astype(np.float32))
    assert (frames[2].depth_m == 2.0).all()
    assert depth_warning(source) is None


def test_ground_truth_is_complete_and_its_quaternions_are_xyzw(tiny_tum):
    (tiny_tum / "groundtruth.txt").write_text("# t\n5.5 1 2 3 0 0 0.6 0.8\n6.5 4 5 6 0 0 0 1\n")
    truth = open_source(tiny_tum).truth()
    assert truth.timestamps_s.tolist() == [5.5, 6.5]
    assert truth.T_world_camera[0, :3, 3].tolist() == [1, 2, 3]
    # qz = 0.6, qw = 0.8 turns x to (1 − 2·0.36, 2·0.6·0.8, 0)
    assert truth.T_world_camera[0, :3, 0] == pytest.approx([0.28, 0.96, 0.0])


def test_without_groundtruth_txt_truth_is_none(tiny_tum):
    (tiny_tum / "groundtruth.txt").unlink()
    assert open_source(tiny_tum).truth() is None


def test_colour_without_depth_is_left_out_with_a_reason(tiny_tum):
    with (tiny_tum / "rgb.txt").open("a") as file:
        file.write("9.0 rgb/0.png\n")
    source = open_source(tiny_tum)
    assert len(source) == 4
    assert source.skipped == [f"{tiny_tum}/rgb/0.png: no depth within 0.02 s, nearest 8.696 s away"]


def test_65535_means_no_reading(tiny_tum):
    depth = np.full((24, 32), 1500, np.uint16)
    depth[0, 0], depth[1, 1] = 65535, 0
    Image.fromarray(depth).save(tiny_tum / "depth/0.png")
    read = open_source(tiny_tum).frame(0).depth_m
    assert read[0, 0] == 0 and read[1, 1] == 0 and read[2, 2] == 1.5


def test_float_depth_is_in_metres(tiny_tum):
    np.save(tiny_tum / "depth/0.npy", np.full((24, 32), 1.25, np.float32))
    (tiny_tum / "depth.txt").write_text((tiny_tum / "depth.txt").read_text().replace("0.png", "0.npy", 1))
    assert (open_source(tiny_tum).frame(0).depth_m == 1.25).all()


def test_the_folders_name_selects_the_camera(tmp_path):
    for name, expected in [
        ("rgbd_dataset_freiburg1_desk", "1"),
        ("rgbd_dataset_freiburg2_xyz", "2"),
        ("freiburg3_long_office", "3"),
        ("fr1", "1"),
        ("fr3_office", "3"),
        ("tum-fr2", "2"),
        ("afr1ca", None),
        ("office", None),
    ]:
        found = freiburg_calibration(tmp_path / name)
        assert (found and (found.camera, found.distortion)) == (
            (FREIBURG[expected].camera, FREIBURG[expected].distortion) if expected else None
        )
        assert found is None or f"freiburg{expected}, named by {name}" in found.origins["camera"].value


def test_calibration_json_overrides_the_folders_name(tiny_tum):
    renamed = tiny_tum.rename(tiny_tum.with_name("freiburg1_desk"))
    assert open_source(renamed).camera.fx == 30.0


def test_only_the_truth_of_tums_own_recordings_is_known_to_be_motion_capture(tiny_tum):
    assert open_source(tiny_tum).truth().error_rms is None
    renamed = tiny_tum.rename(tiny_tum.with_name("freiburg1_desk"))
    assert open_source(renamed, limit=2).truth().error_rms == (0.004, pytest.approx(np.deg2rad(0.3)))


def undistort(points, coefficients):
    """Invert `distort` by fixed-point iteration."""
    ideal = points.copy()
    for _ in range(50):
        ideal = ideal + (points - distort(ideal, coefficients))
    return ideal


@pytest.mark.parametrize("name", ["1", "2"])
def test_undistort_inverts_distort_over_the_image(name):
    """Ideal points where the lens model is one-to-one are restored to 1e-9 of the focal length."""
    camera, coefficients = FREIBURG[name].camera, np.array(FREIBURG[name].distortion)
    points = camera.rays()[40:-40:20, 50:-50:20, :2].reshape(-1, 2).astype(float)
    assert np.abs(undistort(distort(points, coefficients), coefficients) - points).max() < 1e-9
    assert np.abs(distort(undistort(points, coefficients), coefficients) - points).max() < 1e-9


def test_distortion_of_a_point_computed_by_hand():
    # x = 0.5, y = 0, r² = 0.25, k1 = 0.4, p2 = 0.01, p1 = 0.02: x(1 + 0.1) + p2(r² + 2x²), y: p1 r²
    point = distort(np.array([0.5, 0.0]), np.array([0.4, 0, 0.02, 0.01, 0]))
    assert point == pytest.approx([0.55 + 0.01 * 0.75, 0.02 * 0.25])


def test_undistorted_image_shows_the_ideal_scene():
    """Render a smooth scene with distortion; undistorting it must give the scene without distortion."""
    camera = Camera(160, 120, 129.3, 129.1, 79.6, 63.8)

    def scene(ideal):
        value = 0.5 + 0.4 * np.sin(9 * ideal[..., 0]) * np.cos(7 * ideal[..., 1])
        return np.stack([value, 1 - value, value**2], -1).astype(np.float32)

    rays = camera.rays()[..., :2].astype(float)
    filmed = scene(undistort(rays, FR1))
    lens = Undistortion(camera, FR1)
    interior = np.s_[15:-15, 15:-15]
    assert np.abs(lens.color(filmed) - scene(rays))[interior].max() < 4e-3
    assert np.abs(filmed - scene(rays))[interior].max() > 2e-2, (
        "the distortion must be visible for the test to be meaningful"
    )


def test_undistorted_depth_is_not_interpolated_and_moves_with_colour():
    camera = Camera(160, 120, 129.3, 129.1, 79.6, 63.8)
    near = np.zeros((120, 160), bool)
    near[:, 70:] = True
    lens = Undistortion(camera, FR1)
    depth = lens.depth(np.where(near, 1.0, 3.0).astype(np.float32))
    assert set(np.unique(depth)) <= {0.0, 1.0, 3.0}
    white = lens.color(np.repeat(near[..., None], 3, -1).astype(np.float32))[..., 0]
    sharp = (depth > 0) & ((white < 0.02) | (white > 0.98))
    assert ((depth == 1.0) == (white > 0.5))[sharp].all()


def test_a_written_source_reads_back(tmp_path):
    room = SyntheticRoom(frames=3, width=48, height=36)
    write_tum(room, tmp_path / "out")
    back = open_source(tmp_path / "out")
    assert (back.camera, len(back)) == (room.camera, 3)
    for made, read in zip(room, back, strict=True):
        assert np.array_equal(made.color, read.color)
        assert np.abs(made.depth_m - read.depth_m).max() <= 0.5 / 5000 + 1e-6
        assert read.timestamp_s == pytest.approx(made.timestamp_s, abs=1e-6)
    assert np.abs(back.truth().T_world_camera - room.truth().T_world_camera).max() < 1e-7
    with pytest.raises(RunError, match="already holds"):
        write_tum(room, tmp_path / "out")


def test_depth_in_the_wrong_unit_gives_a_warning_with_a_suggestion(tiny_tum):
    calibration = json.loads((tiny_tum / "calibration.json").read_text())
    (tiny_tum / "calibration.json").write_text(json.dumps(calibration | {"depth_scale": 1.0}))
    warning = depth_warning(open_source(tiny_tum))
    assert "2000 m" in warning and "1000 (millimetres)" in warning and "2.00 m" in warning


def test_depth_that_is_far_too_small_gives_a_warning(tiny_tum):
    calibration = json.loads((tiny_tum / "calibration.json").read_text())
    (tiny_tum / "calibration.json").write_text(json.dumps(calibration | {"depth_scale": 100000.0}))
    assert "0.02 m" in depth_warning(open_source(tiny_tum))


@pytest.mark.parametrize(
    ("name", "frames", "focal_px", "median_m"),
    [
        ("redkitchen", 500, 528.12, 1.6),
        ("livingroom", 300, 520.0, 3.2),
        ("hololens", 373, 495.57, 1.8),
        ("cubicles", 50, 570.34, 3.0),
    ],
)
def test_real_sequences_open(data_folder, name, frames, focal_px, median_m):
    source = open_source(data_folder(name))
    assert len(source) == frames and source.camera.fx == pytest.approx(focal_px, abs=0.01)
    assert depth_warning(source) is None and source.skipped == []
    depth_m = source.frame(0).depth_m
    assert np.median(depth_m[depth_m > 0]) == pytest.approx(median_m, rel=0.4)
    assert len(source.truth()) >= frames


def test_real_views_agree_through_the_true_poses(data_folder):
    """Transform points of one view to a later view with the recorded poses: most must lie on its surface."""
    source = open_source(data_folder("livingroom"))
    behind_m, visible = agreement(source, 0, 6)
    assert visible.mean() > 0.7
    assert np.median(np.abs(behind_m[visible])) < 0.005
