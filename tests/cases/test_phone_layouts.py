"""3d Scanner App, ARKitScenes, OpenLORIS and Polycam as people have them; confidence, .r3d files packed again,
files of poses that are not read, gray of 16 bits in bags, and depth that is normalised."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import layouts
import recordings
from bag_recordings import FOCAL, Recorder
from layouts import FRAMES, opengl, sample
from recorded_room import write_images
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import format_of, open_source
from sigmasplat.plugins.checks.recording import first_look
from small_room import frame_at

TIMES = [306.508 + 0.1 * n for n in range(FRAMES)]
MEDIAN = "measured, median of 4 frames, they differ by "


def confident(shape: tuple[int, ...], none: int = 0) -> np.ndarray:
    """Return values of confidence that are above 0 but for the last pixel."""
    values = np.full(shape, 255, np.uint8)
    values[-1, -2:] = 1, none
    return values


def scanner_app(folder: Path) -> Path:
    """Write frames 0, 5, 10, 15 with colour, and frames between them without."""
    seen = sample((64, 48))
    for n in range(16):
        frame, depth_mm = n // 5, seen.depth_mm[n // 5, ::2, ::2]
        fx = 50.0 + 0.05 * frame
        fields = {"frame_index": n, "time": 50.0 + n / 60, "motionQuality": 1, "projectionMatrix": [0] * 16}
        fields |= {"cameraPoseARFrame": np.array(opengl(seen.T_world_camera[frame])).ravel().tolist()}
        fields |= {"intrinsics": [fx, 0, 31.5, 0, fx, 23.5, 0, 0, 1]}
        layouts.save_text(folder / f"frame_{n:05d}.json", json.dumps(fields))
        layouts.save(folder / f"depth_{n:05d}.png", depth_mm)
        layouts.save(folder / f"conf_{n:05d}.png", confident(depth_mm.shape))
        if n % 5 == 0:
            layouts.save(folder / f"frame_{n:05d}.jpg", seen.color[frame])
    layouts.save_text(folder / "info.json", json.dumps({"device": "iPhone13,3"}))
    return folder


def arkitscenes(folder: Path, inner: str = "") -> Path:
    """Write a video of ARKitScenes, whose intrinsics are 1 ms off and whose poses are those of every other frame."""
    frames, seen, lines = folder / inner, sample((32, 24)), []
    for n, t in enumerate(TIMES):
        name = f"41069021_{t:.3f}.png"
        layouts.save(frames / f"lowres_wide/{name}", seen.color[n])
        layouts.save(frames / f"lowres_depth/{name}", seen.depth_mm[n])
        layouts.save(frames / f"confidence/{name}", confident(seen.depth_mm[n].shape))
        pincam = f"32 24 {25 + 0.05 * n} {25 + 0.05 * n} 15.5 11.5\n"
        layouts.save_text(frames / f"lowres_wide_intrinsics/41069021_{t - 0.001:.3f}.pincam", pincam)
        T = np.linalg.inv(seen.T_world_camera[n])
        values = [t + 0.002, *Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]]
        lines += [" ".join(f"{value:.9f}" for value in values)] * (n % 2 == 0)
    layouts.save_text(frames / "lowres_wide.traj", "\n".join(lines) + "\n")
    return folder


def test_3d_scanner_app(tmp_path: Path) -> None:
    folder, seen = scanner_app(tmp_path / "scan"), sample((64, 48))
    source = open_source(folder)
    assert format_of(folder).name == "3d Scanner App" and source.sensor == "lidar-iphone"
    assert [source.timestamp_s(i) for i in range(len(source))] == pytest.approx([50 + n / 60 for n in (0, 5, 10, 15)])
    assert source.camera.fx == pytest.approx(25.0375) and source.camera.cx == pytest.approx(15.5, abs=0.26)
    assert source.origins["camera"].origin.startswith(MEDIAN) and source.path_by == "the device (ARKit)"
    depth_m = source.frame(1).depth_m
    assert depth_m[20, 20] == pytest.approx(seen.depth_mm[1, 40, 40] / 1000, abs=0.02) and depth_m[-1, -1] == 0
    path = source.device_path()
    assert path is not None
    np.testing.assert_allclose(path.T_world_camera, seen.T_world_camera, atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value", "found"),
    [("intrinsics", [1.0], "intrinsics, number 2"), ("intrinsics", None, "intrinsics, number 0"),
     ("cameraPoseARFrame", [1.0], "expected a 4×4 matrix by rows, found 1 values")],
)  # fmt: skip
def test_a_damaged_file_of_3d_scanner_app_is_named(tmp_path: Path, field: str, value: object, found: str) -> None:
    folder = scanner_app(tmp_path / "scan")
    path = folder / "frame_00005.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.raises(SourceError, match=found) as refused:
        open_source(folder)
    assert "frame_00005" in str(refused.value)


@pytest.mark.parametrize("inner", ["", "41069021_frames"])
def test_arkitscenes(tmp_path: Path, inner: str) -> None:
    folder, seen = arkitscenes(tmp_path / "41069021", inner), sample((32, 24))
    source = open_source(folder)
    assert format_of(folder).name == "ARKitScenes" and len(source) == FRAMES and source.sensor == "lidar-iphone"
    assert [source.timestamp_s(i) for i in range(FRAMES)] == pytest.approx(TIMES)
    assert source.camera.fx == pytest.approx(25.075) and source.origins["camera"].origin.startswith(MEDIAN)
    depth_m = seen.depth_mm[1] / np.float32(1000)
    depth_m[-1, -1] = 0
    assert np.allclose(source.frame(1).depth_m, depth_m)
    path = source.device_path()
    assert path is not None and source.path_by == "the device (ARKit)"
    np.testing.assert_allclose(path.T_world_camera, seen.T_world_camera[::2], atol=1e-6)
    posed = open_source(folder, poses="recorded")
    assert len(posed) == 2 and "no pose in recorded" in posed.skipped[0]


def test_arkitscenes_without_path_depth_or_intrinsics(tmp_path: Path) -> None:
    folder = arkitscenes(tmp_path / "41069021")
    (folder / "lowres_wide.traj").unlink()
    assert open_source(folder).truth() is None
    (folder / "lowres_depth/41069021_306.608.png").unlink()
    assert len(open_source(folder)) == FRAMES - 1 and "306.608.png has no depth" in open_source(folder).skipped[0]
    shutil.rmtree(folder / "lowres_wide_intrinsics")
    with pytest.raises(SourceError, match=r"no \.pincam in lowres_wide_intrinsics; download both"):
        open_source(folder)


@pytest.mark.parametrize("name", ["lowres_wide.traj", "lowres_wide_intrinsics/41069021_306.507.pincam"])
def test_damaged_text_of_arkitscenes_is_named(tmp_path: Path, name: str) -> None:
    folder = arkitscenes(tmp_path / "41069021")
    (folder / name).write_text("1 2 3\n")
    with pytest.raises(SourceError, match=r"expected lines of \d numbers, found \[3\]; download it again") as refused:
        open_source(folder)
    assert name in str(refused.value)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("value", ["1e300", "-1e160", "99"])
def test_a_pose_of_arkitscenes_that_is_none_is_left_out(tmp_path: Path, value: str) -> None:
    folder = arkitscenes(tmp_path / "41069021")
    lines = (folder / "lowres_wide.traj").read_text()
    (folder / "lowres_wide.traj").write_text(lines + f"306.7 {value} 0 0 0 0 0\n")
    path = open_source(folder).truth()
    assert path is not None and np.isfinite(path.T_world_camera).all() and len(path) in (2, 3)


SENSORS = """%YAML:1.0
---
d400_depth_optical_frame:
   sensor_type: camera
   width: 848
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 4.1e+02, 4.2e+02, 4.1e+02, 2.4e+02 ]
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: 32
   height: 24
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 3.01e+01, 1.55e+01, 3.02e+01, 1.15e+01 ]
   distortion_model: radial-tangential
   distortion_coefficients: !!opencv-matrix
      rows: 1
      cols: 5
      dt: d
      data: [ 0., 0., 0., 0., 0. ]
t265_fisheye1_optical_frame:
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 2.8e+02, 4.1e+02, 2.8e+02, 3.9e+02 ]
"""


def test_the_colour_camera_of_openloris_is_read_in_its_order(tmp_path: Path) -> None:
    seen = sample()
    for part, images in (("color", seen.color), ("aligned_depth", seen.depth_mm)):
        for n in range(FRAMES):
            layouts.save(tmp_path / f"{part}/{n}.png", images[n])
        lines = [f"{n / 30:.6f} {part}/{n}.png" for n in range(FRAMES)]
        layouts.save_text(tmp_path / f"{part}.txt", "\n".join(lines))
    layouts.save_text(tmp_path / "sensors.yaml", SENSORS)
    source = open_source(tmp_path)
    c = source.camera
    assert (c.fx, c.fy, c.cx, c.cy, c.width) == (30.1, 30.2, 15.5, 11.5, 32)
    assert source.origins["camera"].origin == f"read from {tmp_path / 'sensors.yaml'}"


KEYS = 5_603_927_833, 5_604_211_000, 5_605_100_000, 5_605_700_000


def polycam(folder: Path, kind: str = "") -> Path:
    """Write a raw export: depth with half of the pixels, and a camera file for each image."""
    seen = sample((64, 48))
    for n, key in enumerate(KEYS):
        layouts.save(folder / f"keyframes/{kind}images/{key}.jpg", seen.color[n])
        layouts.save(folder / f"keyframes/depth/{key}.png", seen.depth_mm[n, ::2, ::2])
        pose = np.array(layouts.opengl(seen.T_world_camera[n]))
        fields = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        fields |= {"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "blur_score": 9.0}
        layouts.save_text(folder / f"keyframes/{kind}cameras/{key}.json", json.dumps(fields))
    return folder


@pytest.mark.parametrize("inner", ["", "keyframes"])
def test_polycams_raw_export(inner: str, tmp_path: Path) -> None:
    folder, seen = polycam(tmp_path / "scan"), sample((64, 48))
    source = open_source(folder / inner)
    assert (len(source), source.camera.fx, source.camera.width, source.sensor) == (4, 25.0, 32, "lidar-iphone")
    times_s = [source.timestamp_s(i) for i in range(4)]
    assert times_s == pytest.approx([5603.927833, 5604.211, 5605.1, 5605.7])
    assert source.frame(1).depth_m[20, 20] == pytest.approx(seen.depth_mm[1, 40, 40] / 1000, abs=0.02)
    path = source.device_path()
    assert path is not None
    np.testing.assert_allclose(path.T_world_camera, seen.T_world_camera, atol=1e-9)


def test_polycams_corrected_files_are_preferred_and_lost_depth_is_named(tmp_path: Path) -> None:
    folder = polycam(polycam(tmp_path / "scan"), "corrected_")
    (folder / "keyframes/depth/5605100000.png").unlink()
    source = open_source(folder)
    assert len(list(source)) == 3 and "5605100000" in source.skipped[0]
    assert "corrected_cameras" in source.origins["pairs"].origin


def test_polycam_ignores_readings_without_confidence(tmp_path: Path) -> None:
    folder = polycam(tmp_path / "scan")
    whole = open_source(folder).frame(1).depth_m
    layouts.save(folder / f"keyframes/confidence/{KEYS[1]}.png", confident((24, 32)))
    depth_m = open_source(folder).frame(1).depth_m
    assert whole[-1, -1] > 0 == depth_m[-1, -1] and np.array_equal(depth_m[:-1], whole[:-1])
    layouts.save(folder / f"keyframes/confidence/{KEYS[1]}.png", confident((12, 16)))
    assert "(12, 16) values for depth of (24, 32); copy it again" in refused_frame(folder, 1)


def refused_frame(folder: Path, number: int) -> str:
    with pytest.raises(SourceError) as refused:
        open_source(folder).frame(number)
    return str(refused.value)


@pytest.mark.parametrize("root", ["", "2024-05-01--10-20-30/"])
@pytest.mark.parametrize("given", ["data.r3d", "."])
def test_an_r3d_file_and_its_folder_are_one_recording(tmp_path: Path, root: str, given: str) -> None:
    pytest.importorskip("lzfse", reason="Record3D needs the extra iphone")
    seen = recordings.scene()
    members = {root + name: data for name, data in recordings.r3d_members(seen).items()}
    recordings.write_zip(tmp_path / "data.r3d", members | {f"__MACOSX/{root}._metadata": b"x"})
    source = open_source(tmp_path / given)
    assert len(source) == recordings.FRAMES and source.name == "data"
    assert np.allclose(source.frame(1).depth_m[5, 5], seen.depths_mm[1, 5, 5] / 1000)


@pytest.mark.parametrize("given", ["data.r3d", "."])
def test_an_r3d_file_that_is_none_is_refused_with_one_remedy(tmp_path: Path, given: str) -> None:
    recordings.write_zip(tmp_path / "data.r3d", {"metadata": b"{}", "video.mov": b""})
    with pytest.raises(SourceError, match=r"data\.r3d .*; export it as Shareable/Internal format"):
        open_source(tmp_path / given)


@pytest.mark.parametrize(
    ("name", "head"),
    [("camera_pose.csv", "timestamp,tx,ty,tz,qx,qy,qz,qw\n"), ("trajectory.txt", ""), ("Odometry_1.csv", "#time x\n")],
)
def test_a_file_of_poses_that_is_not_read_is_said_and_can_be_given(tmp_path: Path, name: str, head: str) -> None:
    folder = layouts.plain(tmp_path, sample())
    lines = (folder / "groundtruth.txt").read_text()
    (folder / name).write_text(head + (lines.replace(" ", ",") if name.endswith("csv") else lines))
    assert "poses" not in open_source(folder).origins, "there is truth"
    (folder / "groundtruth.txt").unlink()
    said = next(line for line in open_source(folder).assumptions if line.startswith("poses"))
    assert said == f"poses: none, {name} is not read (--poses {folder / name})"
    posed = open_source(folder, poses=str(folder / name))
    np.testing.assert_allclose(posed.frame(1).T_given_camera, sample().T_world_camera[1], atol=1e-9)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_gray_of_16_bits_in_a_bag_has_the_white_of_a_folder(tmp_path: Path, encoding: str) -> None:
    """12 bits in 16: a fixed factor of 1/256 made such infrared images nearly black."""
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    seen, recorder = recordings.scene(), Recorder()
    deep = [(4095.0 / 255 * color[..., 0]).astype(np.uint16) for color in seen.colors]
    for n, t in enumerate(seen.times_s):
        recorder.image("/ir/image", t, deep[n], encoding, "optical")
        recorder.image("/depth/image", t, seen.depths_mm[n], "16UC1", "optical")
        layouts.save(tmp_path / f"rec/color/{n}.png", deep[n])
        layouts.save(tmp_path / f"rec/depth/{n}.png", seen.depths_mm[n])
    recorder.info("/ir/camera_info", seen.times_s[0], (32, 24), FOCAL, "optical")
    bag = open_source(recorder.write(tmp_path / "bag"), color_topic="/ir/image", depth_topic="/depth/image")
    folder = open_source(tmp_path / "rec", fx=40.0)
    assert bag.origins["gray"] == folder.origins["gray"] and "value 4096 becomes white" in bag.origins["gray"].value
    for i in range(4):
        assert np.array_equal(bag.frame(i).color, folder.frame(i).color)


def float_depth(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    seen = [frame_at(i) for i in range(0, 200, 40)]
    write_images(folder, seen)
    for n, frame in enumerate(seen):
        (folder / f"depth/{n:04d}.png").unlink()
        np.save(folder / f"depth/{n:04d}.npy", change(frame.depth_m).astype(np.float32))
    return folder


CAMERA = {"fx": 128.0, "cx": 79.5, "cy": 59.5}
NORMALISED = {
    "each by its largest": lambda z: z / z.max(),
    "each by its range": lambda z: (z - z.min()) / (z.max() - z.min()),
    "half floats": lambda z: (z / z.max()).astype(np.float16),
    "16 bits": lambda z: np.rint(65535 * z / z.max()) / 65535,
}
METRES = {
    "a desk": lambda z: 0.25 * z,
    "cut off at 1 m": lambda z: np.where(0.4 * z < 1.0, 0.4 * z, 0),
    "cut off at 1 m, in whole mm": lambda z: np.where(0.4 * z <= 1.0, np.rint(400 * z) / 1000, 0),
    "the same in half floats": lambda z: np.where(0.4 * z < 0.9995, 0.4 * z, 0).astype(np.float16),
    "as it is": lambda z: z,
}


@pytest.mark.parametrize("kind", NORMALISED)
def test_normalised_depth_is_said_with_remedies_that_work(tmp_path: Path, kind: str) -> None:
    folder = float_depth(tmp_path / "rec", NORMALISED[kind])
    source = open_source(folder, **CAMERA)
    doubts = [doubt for doubt in source.depth_doubts if "normalised" in doubt]
    assert len(doubts) == 1 and doubts[0] in first_look(source)[1]
    assert "--depth-scale 0.1;" in doubts[0] and "--predicted-depth FOLDER" in doubts[0]
    scaled = open_source(folder, **CAMERA, depth_scale=0.1)
    assert not scaled.depth_doubts and 9.0 < float(scaled.depth_of(0).max()) <= 10.0
    assert not open_source(folder, **CAMERA, predicted_depth=str(folder / "depth")).depth_doubts


@pytest.mark.parametrize("kind", METRES)
def test_metres_of_near_scenes_are_not_called_normalised(tmp_path: Path, kind: str) -> None:
    source = open_source(float_depth(tmp_path / "rec", METRES[kind]), **CAMERA)
    assert not any("normalised" in doubt for doubt in source.depth_doubts)
