"""Frequent mistakes with phones, robots and cameras: one line that says what is wrong, where, and what to do."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bag_recordings import CAMERA_TOPICS, FOCAL, Recorder, aligned
from fake_realsense import Device
from recordings import FRAMES, Scene, encoded, r3d_members, scene, write_exr_export, write_stray, write_zip
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.sources import open_source

for package in ("cv2", "lzfse", "OpenEXR", "rosbags"):
    pytest.importorskip(package, reason="recordings need the extras iphone and ros")

SIZE = (32, 24)
Mistake = tuple[Callable[[Path], Any], dict[str, Any], tuple[str, ...]]


def refusal(path: Any, **options: Any) -> str:
    """Open and read a bad recording; return the error message."""
    with pytest.raises(SigmaSplatError) as caught:
        list(open_source(path, **options))
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    return message


def stray(damage: Callable[[Path], object]) -> Callable[[Path], Path]:
    def make(place: Path) -> Path:
        folder = write_stray(place / "scan", scene(SIZE))
        damage(folder)
        return folder

    return make


def emptied(name: str) -> Callable[[Path], object]:
    return lambda folder: [path.unlink() for path in (folder / name).iterdir()]


STRAY: dict[str, Mistake] = {
    "only depth was copied": (stray(lambda f: (f / "rgb.mp4").unlink()), {}, ("no video in", "rgb.mp4", "copy the")),
    "a phone without LiDAR": (stray(emptied("depth")), {}, ("no depth images in", "depth/000000.png", "LiDAR")),
    "no poses copied": (stray(lambda f: (f / "odometry.csv").unlink()), {}, ("odometry.csv is missing", "copy")),
    "truncated video": (
        stray(lambda f: (f / "rgb.mp4").write_bytes((f / "rgb.mp4").read_bytes()[:300])), {},
        ("rgb.mp4", "unreadable video", "copy it again"),
    ),
    "an app of 2021": (
        stray(lambda f: (f / "odometry.csv").write_text("0.1, 0.2, 0.3, 0, 0, 0, 1\n")), {},
        ("odometry.csv: expected columns timestamp, frame", "found 0.1, 0.2", "2022 or later"),
    ),
    "no camera": (stray(lambda f: (f / "camera_matrix.csv").unlink()), {}, ("camera unknown", "--fx PIXELS")),
    "truncated camera matrix": (
        stray(lambda f: (f / "camera_matrix.csv").write_text("40, 0, 16\n0, 40")), {},
        ("camera_matrix.csv: expected a 3×3 matrix", "copy it again"),
    ),
    "a line that is not a pose": (
        stray(lambda f: (f / "odometry.csv").write_text((f / "odometry.csv").read_text() + "\n1000.2, 9, nan\n")), {},
        (f"odometry.csv:{FRAMES + 2}", "expected 9 numbers"),
    ),
}  # fmt: skip


def r3d(change: Callable[[dict[str, bytes]], object] = lambda m: None, **fields: Any) -> Callable[[Path], Path]:
    def make(place: Path) -> Path:
        members = r3d_members(scene(SIZE), **fields)
        change(members)
        return write_zip(place / "desk.r3d", members)

    return make


def cut_zip(place: Path) -> Path:
    path = r3d()(place)
    path.write_bytes(path.read_bytes()[:-100])
    return path


def export_without_depth(place: Path) -> Path:
    folder = write_exr_export(place / "EXR_RGBD", scene(SIZE))
    for path in list((folder / "depth").iterdir())[:-1]:
        path.unlink()
    (folder / "rgb" / f"{FRAMES - 1}.jpg").unlink(missing_ok=True)
    for path in (folder / "depth").iterdir():
        path.rename(path.with_name(f"{FRAMES - 1}.exr"))
    return folder


def without(ending: str) -> Callable[[dict[str, bytes]], object]:
    return lambda members: [members.pop(name) for name in list(members) if name.endswith(ending)]


RECORD3D: dict[str, Mistake] = {
    "a truncated copy": (cut_zip, {}, ("desk.r3d", "not a complete zip archive", "copy it again")),
    "only colour": (r3d(without(".depth")), {}, ("no depth images in", "rgbd/0.depth", "export it as")),
    "colour and depth do not match": (export_without_depth, {}, ("no depth images in", "depth/0.exr")),
    "no camera": (r3d(K=None), {}, ("camera unknown", "--fx PIXELS")),
    "metadata damaged": (r3d(lambda m: m.update(metadata=b"{")), {}, ("metadata", "not readable as JSON")),
    "metadata missing": (r3d(lambda m: m.pop("metadata")), {}, ("metadata", "cannot be read from its archive")),
    "sizes wrong": (r3d(dw=99), {}, ("rgbd/0.depth", "not 99×24 LZFSE-compressed values")),
    "a pose that is not rigid": (
        r3d(poses=[[0, 0, 0, 2, 1, 2, i] for i in range(FRAMES)]),
        {},
        ("pose 0", "not rigid"),
    ),
    "K as a matrix": (r3d(K=[[40, 0, 0], [0, 40, 0], [16, 12, 1]]), {}, ('field "K"', "9 finite numbers")),
}


def bag(fill: Callable[[Recorder, Scene], object], ros1: bool = True) -> Callable[[Path], Path]:
    def make(place: Path) -> Path:
        recorder = Recorder(ros1=ros1)
        fill(recorder, scene(SIZE))
        return recorder.write(place / ("walk.bag" if ros1 else "walk"))

    return make


def only(*topics: str) -> Callable[[Recorder, Scene], object]:
    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        recorder.messages = [message for message in recorder.messages if message[0] in topics]

    return fill


def two_robots(recorder: Recorder, seen: Scene) -> None:
    for name in ("left", "right"):
        for t, color, depth in zip(seen.times_s, seen.colors, seen.depths_mm, strict=True):
            recorder.image(f"/{name}/color/image", t, color, "rgb8", name)
            recorder.image(f"/{name}/depth/image", t, depth, "16UC1", name)


def apart(recorder: Recorder, seen: Scene, frame: str = "depth_optical", info: bool = True, **more: Any) -> None:
    """Add raw depth of another camera, without transforms."""
    for t, color, depth in zip(seen.times_s, seen.colors, seen.depths_mm[:, ::2, ::2], strict=True):
        recorder.image("/camera/color/image", t, color, "rgb8", "color_optical")
        recorder.image("/camera/depth/image", t + more.get("later_s", 0.0), depth, "16UC1", frame)
    recorder.info("/camera/color/camera_info", seen.times_s[0], SIZE, FOCAL, "color_optical")
    if info:
        recorder.info("/camera/depth/camera_info", seen.times_s[0], (16, 12), FOCAL, frame)


def fisheye(recorder: Recorder, seen: Scene) -> None:
    only(*CAMERA_TOPICS)(recorder, seen)
    lens = (0.1, 0.2, 0.3, 0.4)
    recorder.info("/camera/color/camera_info", seen.times_s[0], SIZE, FOCAL, "cam", lens, "equidistant")


def rvl(recorder: Recorder, seen: Scene) -> None:
    only(CAMERA_TOPICS[0], "/camera/color/camera_info")(recorder, seen)
    for t in seen.times_s:
        picture = encoded(seen.depths_mm[0], "PNG")
        recorder.compressed(
            "/camera/depth_registered/image/compressedDepth", t, bytes(12) + picture, "16UC1; compressedDepth rvl", "x"
        )


def cut_bag(place: Path) -> Path:
    path = bag(aligned)(place)
    path.write_bytes(path.read_bytes()[:-700])
    return path


def never_closed(place: Path) -> Path:
    """A bag whose recorder was killed: the position of the index is 0."""
    path = bag(aligned)(place)
    data = path.read_bytes()
    start = data.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(data[:start] + bytes(8) + data[start + 8 :])
    return path


def half_copied(place: Path) -> Path:
    folder = bag(aligned, ros1=False)(place)
    next(folder.glob("*.db3")).unlink()
    return folder


ROS: dict[str, Mistake] = {
    "no colour recorded": (
        bag(only(CAMERA_TOPICS[1])), {}, ("no colour images in any topic", f"{CAMERA_TOPICS[1]} (sensor_msgs/Image, 4)")
    ),
    "no depth recorded": (bag(only(CAMERA_TOPICS[0])), {}, ("no depth images in any topic", CAMERA_TOPICS[0])),
    "two cameras": (
        bag(two_robots), {}, ("several topics", "/left/color/image, /right/color/image", "--color-topic NAME")
    ),
    "two depths": (
        bag(two_robots), {"color_topic": "/left/color/image"}, ("/left/depth/image", "--depth-topic NAME")
    ),
    "topic misspelt": (
        bag(aligned), {"color_topic": "/camera/color/image_ra"},
        ("no images in topic", f"did you mean {CAMERA_TOPICS[0]}?"),
    ),
    "topic of the wrong kind": (
        bag(aligned), {"color_topic": CAMERA_TOPICS[1]}, (f"no colour images in {CAMERA_TOPICS[1]}",)
    ),
    "no camera_info": (bag(only(*CAMERA_TOPICS)), {}, ("camera unknown", "walk.bag", "--fx PIXELS")),
    "no camera_info of depth": (
        bag(lambda r, s: apart(r, s, info=False)), {}, ("/camera/depth/image has no camera_info", "--calibration FILE")
    ),
    "no tf": (
        bag(apart), {}, ("no transform from the depth camera (depth_optical)", "(color_optical)", "/tf_static")
    ),
    "clocks that differ": (
        bag(lambda r, s: apart(r, s, frame="color_optical", later_s=50.0)), {},
        ("no colour image of", "1000.000 … 1000.100 s", "1050.000 … 1050.100 s"),
    ),
    "a fisheye lens": (bag(fisheye), {}, ("lens model equidistant", "image_rect_color")),
    "depth as RVL": (bag(rvl), {}, ("depth", "RVL", "republish")),
    "a truncated recording": (cut_bag, {}, ("walk.bag: unreadable bag", "rosbag reindex")),
    "recorder killed": (never_closed, {}, ("not indexed", "rosbag reindex")),
    "only half of the folder copied": (half_copied, {}, ("walk: unreadable bag", ".db3", "copy it again")),
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "options", "says"),
    [pytest.param(*mistake, id=name) for table in (STRAY, RECORD3D, ROS) for name, mistake in table.items()],
)
def test_one_line_says_what_to_do(
    make: Callable[[Path], Path], options: dict[str, Any], says: tuple[str, ...], tmp_path: Path
) -> None:
    message = refusal(make(tmp_path), **options)
    for words in says:
        assert words in message, message


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("realsense", ("no RealSense camera provides 640×480 at 30 frames/s", "No device connected", "USB 3")),
        ("realsense:size=5", ("unknown option 'size=5'", "width, height, fps, serial")),
        ("realsense:width=wide", ("unknown option 'width=wide'",)),
        ("realsense:fps=0", ("unknown option 'fps=0'",)),
        ("realsense:width", ("unknown option 'width'",)),
    ],
)
def test_a_missing_camera_or_unknown_option(path: str, says: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device()
    device.plugged_in = False
    monkeypatch.setitem(sys.modules, "pyrealsense2", device.module())
    message = refusal(path)
    for words in says:
        assert words in message


@pytest.mark.parametrize(
    ("module", "extra", "make"),
    [
        ("cv2", "iphone", stray(lambda folder: None)),
        ("lzfse", "iphone", r3d()),
        ("OpenEXR", "iphone", lambda place: write_exr_export(place / "e", scene(SIZE))),
        ("rosbags.rosbag1", "ros", bag(aligned)),
        ("rosbags.rosbag2", "ros", bag(aligned, ros1=False)),
        ("pyrealsense2", "realsense", lambda place: "realsense"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    module: str, extra: str, make: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    assert f"pip install 'sigmasplat[{extra}]'" in refusal(path)


def test_a_damaged_image_is_skipped_and_named(tmp_path: Path) -> None:
    def spoil(members: dict[str, bytes]) -> None:
        members["rgbd/1.depth"] = members["rgbd/1.depth"][:40]
        members["rgbd/2.jpg"] = b"no picture"

    source = open_source(r3d(spoil)(tmp_path))
    assert [frame.index for frame in source] == [0, 3]
    assert "rgbd/1.depth" in source.skipped[0] and "rgbd/2.jpg" in source.skipped[1]


def test_a_damaged_message_is_skipped_and_named(tmp_path: Path) -> None:
    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        recorder.messages[4][3].data = recorder.messages[4][3].data[:100]

    source = open_source(bag(fill)(tmp_path))
    assert [frame.index for frame in source] == [0, 1, 3]
    assert "camera/color/image_raw at 1000.067 s: unreadable image" in source.skipped[0]


def test_the_users_camera_replaces_a_missing_one(tmp_path: Path) -> None:
    """The fix suggested by the error message works."""
    assert open_source(bag(only(*CAMERA_TOPICS))(tmp_path), fx=33.0).camera.fx == 33.0
    camera = dict(zip(("fx", "fy", "cx", "cy"), FOCAL, strict=True))
    inner = camera | {"width": 16, "height": 12}
    file = tmp_path / "mine.json"
    file.write_text(
        json.dumps(camera | {"depth_scale": 1000.0, "depth_camera": inner, "T_color_depth": np.eye(4).tolist()})
    )
    folder = tmp_path / "b"
    folder.mkdir()
    source = open_source(bag(lambda r, s: apart(r, s, info=False))(folder), calibration=str(file))
    assert source.depth_registered and source.camera.width == 16
