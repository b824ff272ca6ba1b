"""Write each data set's layout by hand and read it back: format, camera, colour, depth, times and ground truth."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

import layouts
from documents import ROOT
from layouts import FRAMES, LAYOUTS, SMALL_CAMERA, sample
from paper_settings import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import format_of, formats
from sigmasplat.plugins.checks.recording import inspect_source
from sigmasplat.plugins.sources import open_source

each_layout = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)


@each_layout
def test_round_trip(layout, tmp_path):
    written = sample(layout.size)
    source = open_source(layout.write(tmp_path, written), **layout.options)
    assert list(vars(source.camera).values()) == pytest.approx(list(vars(layout.camera).values()), abs=1e-9)
    frames = list(source)
    assert [f.index for f in frames] == list(range(len(layout.train)))
    times = [layout.times_s[n] for n in layout.train]
    assert [f.timestamp_s for f in frames] == pytest.approx(times, abs=1e-9)
    assert [source.timestamp_s(i) for i in range(len(source))] == [f.timestamp_s for f in frames]
    for frame, n in zip(frames, layout.train, strict=True):
        assert np.abs(frame.color * 255 - written.color[n]).max() < (1e-3 if layout.exact else 8.0)
        assert np.abs(frame.depth_m - written.depth_mm[n] / 1000).max() < 1e-6, "depth is exact, 0 stays 0"
    truth = source.truth()
    assert truth.timestamps_s == pytest.approx([layout.times_s[n] for n in layout.posed], abs=1e-6)
    assert np.abs(truth.T_world_camera - written.T_world_camera[list(layout.posed)]).max() < 1e-6


@each_layout
def test_recognition_is_unambiguous(layout, tmp_path):
    folder = layout.write(tmp_path, sample(layout.size))
    matching = [known for known in formats() if known.recognises(str(folder))]
    assert matching[0].name == layout.format == format_of(folder).name
    assert [known.name for known in matching if known.priority == matching[0].priority] == [layout.format]


@each_layout
def test_the_only_sequence_in_a_folder_is_opened_and_of_several_their_names_are_told(layout, tmp_path):
    folder = layout.write(tmp_path, sample(layout.size))
    outer = folder.parent
    assert open_source(outer, **layout.options).origins["recording"] == (str(folder), f"the only one in {outer}", "")
    shutil.copytree(folder, outer / "second_freiburg3_bonn")
    with pytest.raises(Exception, match=r"holds sequences: .*; give the path of one of them") as caught:
        open_source(outer)
    assert layout.format in str(caught.value)


@each_layout
def test_the_users_camera_overrides_every_format(layout, tmp_path):
    folder = layout.write(tmp_path, sample(layout.size))
    known = open_source(folder, **layout.options)
    units = known.depth_units_per_metre  # None for floats, which are metres
    halved = open_source(folder, depth_scale=2 * (units or 1.0), fx=2 * known.camera.fx, **layout.options)
    assert np.allclose(halved.frame(0).depth_m, known.frame(0).depth_m / 2, atol=1e-6)
    assert halved.camera.fx == 2 * known.camera.fx or halved.depth_registered
    fields = vars(layout.camera) | {"fx": 77.0, "fy": 78.0, "depth_scale": 250.0}
    if known.depth_registered:
        fields["depth_camera"] = vars(layout.camera)
        fields.update(width=64, height=48)
    (folder / "calibration.json").write_text(json.dumps(fields))
    own = open_source(folder, **layout.options)
    scale = 2 if known.depth_registered else 1
    assert (own.camera.fx * scale, own.camera.fy * scale) == (77.0, 78.0)
    assert own.depth_units_per_metre == (250.0 if units else None)


def test_the_documents_list_every_format():
    rows = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    assert [known.name for known in formats() if f"| {known.name} |" not in rows] == []


# ScanNet


def test_scannet_is_processed_at_the_width_of_depth(tmp_path):
    folder = layouts.scannet(tmp_path, sample())
    color, depth = Camera(1296, 968, 1170.19, 1170.19, 647.75, 483.75), Camera(640, 480, 571.62, 571.62, 319.5, 239.5)
    for kind, camera in (("color", color), ("depth", depth)):
        layouts.save_text(folder / f"intrinsic/intrinsic_{kind}.txt", layouts.rows(layouts.intrinsic(camera)))
    for n in range(FRAMES):
        layouts.save(folder / f"color/{n * 7}.jpg", np.full((968, 1296, 3), 99, np.uint8))
        layouts.save(folder / f"depth/{n * 7}.png", np.full((480, 640), 2000, np.uint16))
    source = open_source(folder)
    assert source.depth_registered and source.camera == color.resized(640, 478)
    assert (source.frame(1).depth_m[20:-20, 20:-20] == 2.0).all()
    for n in range(FRAMES):  # an exporter may have resized colour without its matrix
        layouts.save(folder / f"color/{n * 7}.jpg", np.full((480, 640, 3), 99, np.uint8))
    assert open_source(folder).camera == color.resized(640, 480)


def test_scannet_extrinsics_transform_a_common_frame_to_each_camera(tmp_path):
    folder = layouts.scannet(tmp_path, sample())
    E_color, E_depth = np.eye(4), np.eye(4)
    E_color[2, 3], E_depth[2, 3] = 0.25, -0.25  # the colour camera is half a metre behind the depth camera
    layouts.save_text(folder / "intrinsic/extrinsic_color.txt", layouts.rows(E_color))
    layouts.save_text(folder / "intrinsic/extrinsic_depth.txt", layouts.rows(E_depth))
    for n in range(FRAMES):
        layouts.save(folder / f"depth/{n * 7}.png", np.full((24, 32), 2000, np.uint16))
    assert open_source(folder).frame(0).depth_m[12, 16] == 2.5


def test_scannet_frames_25k_keeps_its_matrices_in_the_scenes_folder(tmp_path):
    folder = layouts.scannet(tmp_path, sample())
    for kind in ("color", "depth"):
        (folder / f"intrinsic/intrinsic_{kind}.txt").rename(folder / f"intrinsics_{kind}.txt")
    assert open_source(folder).camera == SMALL_CAMERA


def test_a_scene_without_poses_has_no_ground_truth(tmp_path):
    folder = layouts.scannet(tmp_path, sample())
    for path in (folder / "pose").iterdir():
        path.write_text(layouts.rows(np.full((4, 4), -np.inf)))
    source = open_source(folder)
    assert source.truth() is None and len(source) == FRAMES


def test_a_preprocessed_scene_without_a_matrix_has_the_published_depth_camera(tmp_path):
    scene = layouts.scannet_preprocessed(tmp_path, sample(layouts.VGA))
    (scene / "intrinsic.txt").unlink()
    source = open_source(scene)
    assert source.camera == Camera(640, 480, 577.590698, 578.729797, 318.905426, 242.683609)
    assert source.sensor == "kinect-v1" and source.origins["camera"].origin == "assumed"


def test_poses_of_a_preprocessed_scene_that_are_cut_off_are_refused(tmp_path):
    scene = layouts.scannet_preprocessed(tmp_path, sample())
    path = scene / "gt_pose.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    with pytest.raises(SourceError, match=r"gt_pose.txt: 3 poses, but the last image has number 3; is the file trunc"):
        open_source(scene)


# ScanNet++


def test_test_views_are_separate_with_poses_in_the_same_world(tmp_path):
    written = sample()
    scene = layouts.scannetpp(tmp_path, written)
    views = open_source(scene, stride=2).test_views()
    assert len(views) == 1 and views.camera == open_source(scene / "dslr").camera
    assert np.abs(views.frame(0).depth_m - written.depth_mm[3] / 1000).max() < 1e-6
    assert np.abs(views.truth().T_world_camera[0] - written.T_world_camera[3]).max() < 1e-9
    assert open_source("synthetic:frames=2").test_views() is None


def test_the_papers_presets_for_it_are_suggested(tmp_path):
    rows = dict(inspect_source(layouts.scannetpp(tmp_path, sample()), InputConfig()).rows)
    assert "loopsplat-scannetpp, varsplat-scannetpp" in rows["suggested preset"]


def test_without_lists_photographs_are_sorted_by_name(tmp_path):
    scene = layouts.scannetpp(tmp_path, sample())
    (scene / "dslr/train_test_lists.json").unlink()
    truth = open_source(scene).truth().T_world_camera
    assert np.abs(truth - sample().T_world_camera[:3]).max() < 1e-9


# 7-Scenes


def test_the_only_sequence_of_a_scene_is_opened(tmp_path):
    folder = layouts.seven_scenes(tmp_path, sample(layouts.VGA))
    assert open_source(folder.parent).name == "seq-01"


def test_registering_seven_scenes_converts_depth_and_the_true_path_to_the_colour_camera(tmp_path):
    written = sample(layouts.VGA)
    folder = layouts.seven_scenes(tmp_path, written)
    for n in range(FRAMES):
        layouts.save(folder / f"frame-{n:06d}.depth.png", np.full((480, 640), 2000, np.uint16))
    raw, moved = open_source(folder), open_source(folder, register_depth="on")
    assert not raw.depth_registered and moved.depth_registered and moved.camera.fx == 528.12
    assert raw.registrable and moved.registrable, "so that the report can suggest --register-depth"
    # The world position of the depth camera's middle pixel, computed from the registered frame and the true path.
    point = written.T_world_camera[1] @ [0.0, 0.0, 2.0, 1.0]
    x, y, z, _ = np.linalg.inv(moved.truth().T_world_camera[1]) @ point
    c = moved.camera
    u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
    assert moved.frame(1).depth_m[round(v), round(u)] == pytest.approx(z, abs=1e-3)
    assert (u, v) != pytest.approx((320, 240), abs=3.0) and z == pytest.approx(2.007, abs=2e-3)


def test_registered_depth_of_red_kitchen_equals_the_registered_copy(data_folder):
    raw = open_source(data_folder("redkitchen_raw"), register_depth="on")
    copy = open_source(data_folder("redkitchen"))
    times = [copy.timestamp_s(i) for i in range(len(copy))]
    both = [(i, times.index(t)) for i in range(len(raw)) for t in times if abs(raw.timestamp_s(i) - t) < 1e-3]
    assert len(both) > 10
    for i, j in both[::8]:
        a, b = raw.frame(i), copy.frame(j)
        seen = (a.depth_m > 0) & (b.depth_m > 0)
        assert np.array_equal(a.color, b.color) and seen.mean() > 0.98 * (b.depth_m > 0).mean()
        assert np.median(np.abs(a.depth_m - b.depth_m)[seen]) < 5e-4, "half a millimetre, the resolution of depth"
        near = np.abs(copy.truth().timestamps_s - raw.timestamp_s(i)).argmin()
        assert np.abs(raw.truth().T_world_camera[i] - copy.truth().T_world_camera[near]).max() < 2e-4


# ICL-NUIM


def test_icl_nuims_negative_focal_length_equals_ours_in_the_mirrored_world(tmp_path):
    written = sample(layouts.VGA)
    folder = layouts.icl_nuim(tmp_path, written)
    source = open_source(folder)
    published = np.array([[481.2, 0, 319.5], [0, -480.0, 239.5], [0, 0, 1]])
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    u, v, z = 100.0, 400.0, 1.5
    theirs = mirror @ written.T_world_camera[2] @ mirror @ [*(z * np.linalg.inv(published) @ [u, v, 1.0]), 1.0]
    c = source.camera
    ours = source.truth().T_world_camera[2] @ [(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z, 1.0]
    assert ours == pytest.approx(mirror @ theirs, abs=1e-6)
    assert source.truth().error_rms == (0.0, 0.0)


def test_an_association_file_of_real_times_is_read_without_the_mirror(tmp_path, tiny_tum):
    for name in ("rgb.txt", "depth.txt"):
        (tiny_tum / name).unlink()
    lines = "".join(f"{i / 10:.3f} rgb/{i}.png {i / 10 + 0.004:.3f} depth/{i}.png\n" for i in range(4))
    (tiny_tum / "associations.txt").write_text(lines)
    source = open_source(tiny_tum)
    assert [f.timestamp_s for f in source] == [0.0, 0.1, 0.2, 0.3] and (source.frame(0).depth_m == 2.0).all()
    assert source.truth().T_world_camera[3, 0, 3] == 3.0


# nerfstudio


def transformed(folder, **changes):
    """Change the fields of transforms.json."""
    path = folder / "transforms.json"
    fields = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in fields.items() if value is not None}))


def test_nerfstudios_origin_is_the_corner_of_the_first_pixel(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    transformed(folder, cx=16.0, cy=12.0)
    camera = open_source(folder).camera
    assert (camera.cx, camera.cy) == (15.5, 11.5), "the centre of 32×24 pixels"


def test_an_opengl_camera_looks_along_minus_z_with_y_up(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    transformed(folder, frames=[frame | {"transform_matrix": np.eye(4).tolist()} for frame in frames])
    source = open_source(folder)
    top = source.truth().T_world_camera[0] @ [0.0, -1.0, 2.0, 1.0]  # up in our image, two metres ahead
    assert top.tolist() == [0.0, 1.0, -2.0, 1.0]


def test_a_confidence_that_is_no_name_of_an_image_is_ignored(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    plain = open_source(folder).frame(0).depth_m
    transformed(folder, frames=[frame | {"confidence": 0.9} for frame in frames])
    assert (open_source(folder).frame(0).depth_m == plain).all()


def test_intrinsics_per_frame_or_as_field_of_view(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    fields = json.loads((folder / "transforms.json").read_text())
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    inner = {key: fields[key] for key in keys}
    transformed(folder, frames=[f | inner for f in fields["frames"]], **dict.fromkeys(keys))
    assert open_source(folder).camera == SMALL_CAMERA
    transformed(folder, frames=fields["frames"], camera_angle_x=2 * np.arctan(0.5))
    camera = open_source(folder).camera
    assert (camera.fx, camera.fy, camera.cx) == pytest.approx((32.0, 32.0, 15.5))


def test_smaller_depth_has_the_same_camera_and_the_unit_of_the_file(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    for path in (folder / "depths").iterdir():
        Image.fromarray(np.full((12, 16), 200, np.uint16)).save(path)
    transformed(folder, depth_unit_scale_factor=0.01)
    source = open_source(folder)
    assert source.depth_registered and source.camera == SMALL_CAMERA.resized(16, 12)
    assert (source.frame(0).depth_m == 2.0).all() and source.depth_units_per_metre == 100.0


def test_distortion_is_removed_and_frames_may_lack_pose_or_depth(tmp_path):
    folder = layouts.nerfstudio(tmp_path, sample())
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    named = {frame["file_path"]: frame for frame in frames}
    del named["images/frame_9.png"]["transform_matrix"], named["images/frame_11.png"]["depth_file_path"]
    transformed(folder, frames=frames, k1=0.2)
    source = open_source(folder)
    assert len(source) == 3 and len(source.truth()) == 2 and "frame_11" in source.skipped[0]
    straight = open_source(folder, undistort=False)
    assert np.abs(source.frame(0).color - straight.frame(0).color).max() > 0.02


# Plain folders and Open3D's


@pytest.mark.parametrize("names", [("color", "depth"), ("rgb", "depth"), ("images", "depths"), ("image", "depth")])
def test_folders_may_have_several_names(names, tmp_path):
    folder = layouts.plain(tmp_path, sample())
    (folder / "color").rename(folder / "c")
    (folder / "depth").rename(folder / names[1])
    (folder / "c").rename(folder / names[0])
    assert len(open_source(folder)) == FRAMES


@pytest.mark.parametrize(
    ("color", "depth", "kept"),
    [("img_{:03d}", "d{:03d}_16bit", [0, 1, 2, 3]), ("{}", "x{}", [0, 1, 2, 3]), ("a{}", "{}00", [0, 1, 2, 3])],
)
def test_pairs_by_number_and_by_order(color, depth, kept, tmp_path):
    folder = layouts.plain(tmp_path, sample())
    for n in range(FRAMES):
        (folder / f"color/{n + 8}.png").rename(folder / f"color/{color.format(n + 8)}.png")
        (folder / f"depth/{n + 8}.png").rename(folder / f"depth/{depth.format(n + 8)}.png")
    depths = [frame.depth_m[-1, -1] for frame in open_source(folder)]
    assert depths == pytest.approx(sample().depth_mm[kept, -1, -1] / 1000)


def test_names_with_a_decimal_point_are_times(tmp_path):
    folder = layouts.plain(tmp_path, sample())
    for n in range(FRAMES):
        for part in ("color", "depth"):
            (folder / f"{part}/{n + 8}.png").rename(folder / f"{part}/{12.5 + n / 4:.6f}.png")
    assert [frame.timestamp_s for frame in open_source(folder)] == [12.5, 12.75, 13.0, 13.25]


def test_a_plain_folder_needs_only_a_focal_length(tmp_path):
    folder = layouts.plain(tmp_path, sample())
    (folder / "calibration.json").unlink()
    source = open_source(folder, fx=30.0)
    assert source.camera == Camera(32, 24, 30.0, 30.0, 15.5, 11.5) and source.depth_units_per_metre == 1000.0


@pytest.mark.parametrize("text", ["started recording\n", ""])
def test_a_log_without_poses_is_not_a_path(text, tmp_path):
    folder = layouts.open3d(tmp_path, sample())
    (folder / "trajectory.log").unlink()
    (folder / "capture.log").write_text(text)
    assert open_source(folder).truth() is None
    (folder / "camera_intrinsic.json").unlink()
    assert format_of(folder).name == "plain folder"


def test_a_log_of_odometry_is_not_ground_truth(tmp_path):
    folder = layouts.open3d(tmp_path, sample())
    (folder / "trajectory.log").rename(folder / "odometry.log")
    assert open_source(folder).truth() is None
