"""Bags of ROS 1, ROS 2 (SQLite, MCAP) and RealSense's SDK: topics, times, pixels, cameras and poses."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bag_recordings import CAMERA_TOPICS, FOCAL, Recorder, aligned, compressed_depth, quantised_depth
from recordings import FRAMES, Scene, encoded, scene
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.images import resized_color
from sigmasplat.errors import SourceError
from sigmasplat.input.rectification import DepthRegistration, Undistortion, distort
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.bag_messages import Bag

pytest.importorskip("rosbags", reason="bags need the extra ros")

SIZE, COLOR_FRAME, DEPTH_FRAME = (32, 24), "camera_color_optical_frame", "camera_depth_optical_frame"
DEPTH_FOCAL = (20.0, 20.5, 8.0, 6.0)
LINK = se3.exp(np.array([0.02, -0.01, 0.005, 0.02, -0.03, 0.01]))


def metres(depth_mm: np.ndarray) -> np.ndarray:
    return (depth_mm / 1000.0).astype(np.float32)


def written(tmp_path: Path, kind: str, fill: "object" = aligned) -> tuple[Path, Scene]:
    """Write a scene as ROS 1, or as ROS 2 in a folder or a bare storage file."""
    seen, recorder = scene(SIZE), Recorder(ros1=kind == "ros1")
    fill(recorder, seen)  # type: ignore[operator]
    if kind == "ros1":
        return recorder.write(tmp_path / "walk.bag"), seen
    folder = recorder.write(tmp_path / "walk", "mcap" if "mcap" in kind else "sqlite3")
    return next(folder.glob("walk.*")) if kind.startswith("bare") else folder, seen


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap", "bare mcap", "bare sqlite3"])
def test_every_kind_of_bag_gives_equal_frames(tmp_path: Path, kind: str) -> None:
    path, seen = written(tmp_path, kind)
    source = open_source(path)
    assert (source.name, len(source), source.skipped) == ("walk", FRAMES, [])
    assert source.camera == Camera(*SIZE, *FOCAL)
    assert not source.depth_registered and source.depth_units_per_metre == 1000.0
    for frame, color, depth, t in zip(source, seen.colors, seen.depths_mm, seen.times_s, strict=True):
        assert frame.timestamp_s == pytest.approx(t, abs=1e-6) and frame.depth_late_s == pytest.approx(0.004, abs=1e-6)
        assert np.array_equal(np.rint(frame.color * 255), color)
        assert np.array_equal(frame.depth_m, metres(depth))
    assert np.array_equal(source.frame(1).depth_m, metres(seen.depths_mm[1]))  # read backwards after the end


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_encodings(tmp_path: Path, kind: str) -> None:
    """BGR order, an alpha channel, padded rows, big-endian numbers, float metres with NaN."""

    def fill(recorder: Recorder, seen: Scene) -> None:
        rgba = np.concatenate([seen.colors, np.full((*seen.colors.shape[:3], 1), 9, np.uint8)], -1)
        depth = metres(seen.depths_mm)
        depth[depth == 0] = np.nan
        depth[:, 5, 5] = np.inf
        colors = [(seen.colors[0][..., ::-1], "bgr8"), (rgba[1], "rgba8"), (rgba[2][..., [2, 1, 0, 3]], "bgra8")]
        for (color, name), t in zip([*colors, (seen.colors[3], "rgb8")], seen.times_s, strict=True):
            recorder.image("/rgb/image", t, np.ascontiguousarray(color), name, "cam", pad=5)
        depths = [(seen.depths_mm[0], "16UC1"), (seen.depths_mm[1], "mono16"), (depth[2], "32FC1"), (depth[3], "32FC1")]
        for i, ((image, name), t) in enumerate(zip(depths, seen.times_s, strict=True)):
            recorder.image("/depth/image", t, image, name, "cam", pad=3, big=i in (1, 3))
        recorder.info("/rgb/camera_info", seen.times_s[0], SIZE, FOCAL, "cam")

    path, seen = written(tmp_path, kind, fill)
    for i, frame in enumerate(open_source(path)):
        expected = metres(seen.depths_mm[i])
        if i >= 2:
            expected[5, 5] = 0
        assert np.array_equal(np.rint(frame.color * 255), seen.colors[i])
        assert np.array_equal(frame.depth_m, expected)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_compressed_images(tmp_path: Path, kind: str) -> None:
    def fill(recorder: Recorder, seen: Scene) -> None:
        for i, t in enumerate(seen.times_s):
            jpeg = encoded(seen.colors[i], "JPEG", quality=97, subsampling=0)
            color = (jpeg, "bgr8; jpeg compressed bgr8") if i % 2 else (encoded(seen.colors[i], "PNG"), "rgb8; png")
            recorder.compressed("/cam/rgb/image_raw/compressed", t, *color, "cam")
            deep = quantised_depth(metres(seen.depths_mm[i])) if i % 2 else compressed_depth(seen.depths_mm[i])
            name = "32FC1; compressedDepth png" if i % 2 else "16UC1; compressedDepth"
            recorder.compressed("/cam/depth_registered/image_raw/compressedDepth", t, deep, name, "cam")
        recorder.info("/cam/rgb/camera_info", seen.times_s[0], SIZE, FOCAL, "cam")

    path, seen = written(tmp_path, kind, fill)
    for i, frame in enumerate(open_source(path)):
        # 1/depth has steps of 1/a: 3 m is restored within 9/10000 m
        assert np.abs(frame.depth_m - metres(seen.depths_mm[i])).max() < (1e-3 if i % 2 else 1e-9)
        assert np.abs(frame.color - seen.colors[i] / 255).max() < (0.06 if i % 2 else 1e-6)


def raw_depth(recorder: Recorder, seen: Scene, linked: str = "/tf_static") -> None:
    """Add a smaller depth camera beside the colour camera, and the transforms from both to the device."""
    for color, depth, t in zip(seen.colors, seen.depths_mm[:, ::2, ::2], seen.times_s, strict=True):
        recorder.image("/camera/color/image_raw", t, color, "rgb8", COLOR_FRAME)
        recorder.image("/camera/depth/image_rect_raw", t, depth, "16UC1", DEPTH_FRAME)
        recorder.image("/camera/infra1/image_rect_raw", t, depth, "mono16", "infra")
    recorder.info("/camera/color/camera_info", seen.times_s[0], SIZE, FOCAL, COLOR_FRAME)
    recorder.info("/camera/depth/camera_info", seen.times_s[0], (16, 12), DEPTH_FOCAL, DEPTH_FRAME)
    if linked:
        turn = se3.exp(np.array([0.1, 0, 0, 1.0, -1.0, 0.5]))
        recorder.transform(linked, seen.times_s[0], "camera_link", COLOR_FRAME, turn)
        recorder.transform(linked, seen.times_s[0], "camera_link", DEPTH_FRAME, turn @ LINK)


@pytest.mark.parametrize(("kind", "linked"), [("ros1", "/tf_static"), ("ros1", "/tf"), ("mcap", "/tf_static")])
def test_raw_depth_is_registered_by_the_transforms(tmp_path: Path, kind: str, linked: str) -> None:
    path, seen = written(tmp_path, kind, lambda recorder, seen: raw_depth(recorder, seen, linked))
    source = open_source(path)
    assert source.depth_registered and source.camera == Camera(*SIZE, *FOCAL).resized(16, 12)
    rectified = Camera(16, 12, DEPTH_FOCAL[0] + 1, DEPTH_FOCAL[1] + 1, *DEPTH_FOCAL[2:])  # P, not K
    move = DepthRegistration(rectified, source.camera, LINK)
    for frame, depth_mm in zip(source, seen.depths_mm[:, ::2, ::2], strict=True):
        np.testing.assert_allclose(frame.depth_m, move(metres(depth_mm)), atol=1e-6)


def test_one_optical_frame_means_registered(tmp_path: Path) -> None:
    """TUM's bags are like this, although their depth has its own camera_info."""

    def fill(recorder: Recorder, seen: Scene) -> None:
        for color, depth, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
            recorder.image("/camera/rgb/image_color", t, color, "rgb8", "/openni_rgb_optical_frame")
            recorder.image("/camera/depth/image", t + 0.015, metres(depth), "32FC1", "/openni_rgb_optical_frame")
        for topic in ("/camera/rgb/camera_info", "/camera/depth/camera_info"):
            recorder.info(topic, seen.times_s[0], SIZE, FOCAL, "/openni_rgb_optical_frame")

    path, seen = written(tmp_path, "ros1", fill)
    source = open_source(path)
    assert not source.depth_registered
    assert np.array_equal(source.frame(2).depth_m, metres(seen.depths_mm[2]))


def test_the_best_topic_is_used_or_the_requested_one(tmp_path: Path) -> None:
    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        raw_depth(recorder, seen)
        for t, color in zip(seen.times_s, seen.colors, strict=True):
            data = encoded(color, "JPEG")
            recorder.compressed(
                "/camera/color/image_raw/compressed", t, data, "rgb8; jpeg compressed bgr8", COLOR_FRAME
            )

    recorder, seen = Recorder(), scene(SIZE)
    fill(recorder, seen)
    seen_once = [m for i, m in enumerate(recorder.messages) if m[0] != CAMERA_TOPICS[0] or i < 2 * FRAMES]
    recorder.messages = seen_once  # both wrote the colour images
    path = recorder.write(tmp_path / "bag")
    best, asked = open_source(path), open_source(path, depth_topic="/camera/depth/image_rect_raw")
    assert not best.depth_registered and best.frame(0).depth_m.shape == (24, 32)
    assert asked.depth_registered and asked.frame(0).depth_m.shape == (12, 16)
    assert np.array_equal(np.rint(best.frame(0).color * 255), seen.colors[0])  # the uncompressed one
    compressed = open_source(path, color_topic="/camera/color/image_raw/compressed")
    assert 0 < np.abs(compressed.frame(0).color - seen.colors[0] / 255).max() < 0.2


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("plumb_bob", (0.1, -0.05, 0.001, -0.002, 0.01)),
        ("rational_polynomial", (0.5, -2.0, 0.001, 0.0, 1.5, 0.4, -1.9, 1.4)),
    ],
)
def test_lenses(tmp_path: Path, model: str, lens: tuple[float, ...]) -> None:
    """The recorded distortion is OpenCV's: its function distorts points as ours does, and is removed from images."""
    cv2 = pytest.importorskip("cv2")

    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        recorder.messages = [m for m in recorder.messages if "info" not in m[0]]
        recorder.info("/camera/color/camera_info", seen.times_s[0], SIZE, FOCAL, COLOR_FRAME, lens, model)

    path, seen = written(tmp_path, "ros1", fill)
    straight = Undistortion(Camera(*SIZE, *FOCAL), lens).color((seen.colors[1] / 255).astype(np.float32))
    np.testing.assert_allclose(open_source(path).frame(1).color, straight, atol=1e-6)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    theirs, _ = cv2.projectPoints(np.c_[points, np.ones(20)], np.zeros(3), np.zeros(3), np.eye(3), np.array(lens))
    np.testing.assert_allclose(distort(points, np.array(lens)), theirs[:, 0], atol=1e-12)


def test_without_header_times_the_recording_times_are_used(tmp_path: Path) -> None:
    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        for _, kind, _, message in recorder.messages:
            if kind.endswith("/Image"):
                message.header.stamp.sec = message.header.stamp.nanosec = 0

    path, seen = written(tmp_path, "sqlite3", fill)
    source = open_source(path, color_topic=CAMERA_TOPICS[0])
    # Colour is received 50 ms late, depth 16 ms: by recording time, colour pairs with the depth of the next frame.
    assert [f.timestamp_s for f in source] == pytest.approx(list(seen.times_s[:-1] + 0.05), abs=1e-6)
    assert np.array_equal(source.frame(0).depth_m, metres(seen.depths_mm[1]))


def test_poses_in_a_bag_are_no_ground_truth(tmp_path: Path) -> None:
    """They are those of another tracker: odometry, as a rule."""

    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        for t, T in zip(seen.times_s, seen.poses, strict=True):
            recorder.add("/odom", t, recorder.pose(t, T))

    path, _ = written(tmp_path, "ros1", fill)
    assert open_source(path).truth() is None


def sdk_bag(path: Path, seen: Scene) -> Path:
    """Write the topics that RealSense's SDK 2.57 writes, with its four extra bytes after an image."""
    recorder = Recorder(ros1=True)
    stream = "/device_0/sensor_{}/{}_0"
    color, depth = stream.format(1, "Color"), stream.format(0, "Depth")
    start = float(seen.times_s[0])
    for name, size, focal in ((color, SIZE, FOCAL), (depth, (16, 12), DEPTH_FOCAL)):
        model = "Inverse Brown Conrady" if name == color else "Brown Conrady"
        lens = (0.1, -0.05, 0.001, -0.002, 0.01) if name == color else (0.0,) * 5
        recorder.info(f"{name}/info/camera_info", start, size, focal, "", lens, model)
    units = recorder.make("std_msgs/msg/Float32", data=0.0005)
    recorder.add("/device_0/sensor_0/option/Depth_Units/value", start, units)
    T_color_reference = se3.exp(np.array([0.1, 0.2, 0.3, 0.3, 0.2, 0.1]))
    recorder.add(f"{color}/tf/1", start, recorder.moved(T_color_reference))
    recorder.add(f"{depth}/tf/1", start, recorder.moved(se3.inverse(LINK) @ T_color_reference))
    for image, deep, t in zip(seen.colors, seen.depths_mm[:, ::2, ::2], seen.times_s, strict=True):
        recorder.image(f"{color}/image/data", t, image, "rgb8", "1")
        recorder.image(f"{depth}/image/data", t, deep, "mono16", "1")
    plain = recorder.store.serialize_ros1
    recorder.store.serialize_ros1 = lambda message, kind: (  # type: ignore[method-assign]
        bytes(plain(message, kind)) + (b"\x00\x00\x00\x00" if kind.endswith("/Image") else b"")
    )
    return recorder.write(path)


def test_a_realsense_sdks_bag(tmp_path: Path) -> None:
    seen = scene(SIZE)
    path = sdk_bag(tmp_path / "d435.bag", seen)
    straight, bent = open_source(path), open_source(path, undistort=False)
    color = (seen.colors[2] / 255).astype(np.float32)
    lens = Undistortion(Camera(*SIZE, *FOCAL), (0.1, -0.05, 0.001, -0.002, 0.01))
    np.testing.assert_allclose(bent.frame(2).color, resized_color(color, 16, 12), atol=1e-6)
    np.testing.assert_allclose(straight.frame(2).color, resized_color(lens.color(color), 16, 12), atol=1e-6)
    depth_m = (seen.depths_mm[2, ::2, ::2] / 2000.0).astype(np.float32)
    moved = DepthRegistration(Camera(16, 12, *DEPTH_FOCAL), bent.camera, LINK)(depth_m)
    for source in (straight, bent):
        assert source.depth_units_per_metre == 2000.0 and source.depth_registered
        np.testing.assert_allclose(source.frame(2).depth_m, moved, atol=1e-6)


def test_a_time_span_of_a_bag_can_be_selected(tmp_path: Path) -> None:
    path, _ = written(tmp_path, "mcap")
    assert len(open_source(path, start_s=0.03, end_s=0.09)) == 2


def test_a_bag_keeps_no_messages_in_memory(tmp_path: Path) -> None:
    """Only the position of each message is kept: three numbers."""
    path, _ = written(tmp_path, "mcap")
    bag = Bag(path)
    entries = bag.index(*CAMERA_TOPICS)[CAMERA_TOPICS[0]]
    assert [vars(entry).keys() for entry in entries] == [{"recorded_ns", "place", "stamp_ns"}] * FRAMES
    assert bag.read(CAMERA_TOPICS[0], entries[3]).height == 24


def test_messages_with_equal_times_are_distinguished(tmp_path: Path) -> None:
    def fill(recorder: Recorder, seen: Scene) -> None:
        aligned(recorder, seen)
        recorder.messages = [(topic, kind, 5 * 10**9, message) for topic, kind, _, message in recorder.messages]

    path, seen = written(tmp_path, "ros1", fill)
    for frame, color in zip(open_source(path), seen.colors, strict=True):
        assert np.array_equal(np.rint(frame.color * 255), color)


def test_a_moved_bag_can_be_opened(tmp_path: Path) -> None:
    path, _ = written(tmp_path, "sqlite3")
    shutil.move(path, tmp_path / "elsewhere")
    assert len(open_source(tmp_path / "elsewhere")) == FRAMES


def test_a_missing_package_is_named_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = written(tmp_path, "ros1")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
    with pytest.raises(SourceError, match=r"pip install 'sigmasplat\[ros\]'"):
        open_source(path)
