"""Lists and poses with other columns and units, bags with other topics, phones and OpenLORIS as their data sets are."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import layouts
import recordings
from bag_recordings import FOCAL, Recorder
from layouts import FRAMES, SMALL_CAMERA, sample
from recordings import encoded, scene
from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import open_source

CALIBRATION = json.dumps(vars(SMALL_CAMERA) | {"depth_scale": 1000.0})
DATED = [1612345678.0333 + n / 30 for n in range(FRAMES)]


def listed(folder: Path, line: str, times: list[float], unit: float = 1.0, head: str = "") -> Path:
    """Write TUM's lists with lines of another form, and times in another unit."""
    seen = sample()
    for part, images in (("rgb", seen.color), ("depth", seen.depth_mm)):
        for n in range(FRAMES):
            layouts.save(folder / f"{part}/{n}.png", images[n])
        stamps = [f"{times[n] * unit:.6f}" if unit == 1 else f"{times[n] * unit:.0f}" for n in range(FRAMES)]
        lines = [line.format(n=n, t=stamps[n], path=f"{part}/{n}.png") for n in range(FRAMES)]
        layouts.save_text(folder / f"{part}.txt", head + "\n".join(lines) + "\n")
    layouts.save_text(folder / "calibration.json", CALIBRATION)
    return folder


@pytest.mark.parametrize(
    ("line", "head"),
    [
        ("{t},{path}", "timestamp,filename\n"),
        ("{t} {path} 0.0125 7", ""),
        ("{n} {t} {path}", ""),
        ("{n},{t},{path}", ""),
    ],
)
def test_lists_with_a_header_further_columns_or_ids(tmp_path: Path, line: str, head: str) -> None:
    times = [12 + n / 30 for n in range(FRAMES)]
    source = open_source(listed(tmp_path, line, times, head=head))
    assert len(list(source)) == FRAMES
    assert [source.timestamp_s(i) for i in range(FRAMES)] == pytest.approx(times, abs=1e-6)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_lists_and_poses_in_other_units_are_known_by_their_dates(tmp_path: Path, unit: float) -> None:
    folder = listed(tmp_path, "{t} {path}", DATED, unit)
    lines = [f"{t * unit:.0f} {n / 10} 0 0 0 0 0 1\n" for n, t in enumerate(DATED)]
    (folder / "poses.txt").write_text("".join(lines))
    source = open_source(folder, poses=str(folder / "poses.txt"))
    assert [source.timestamp_s(i) for i in range(FRAMES)] == pytest.approx(DATED, abs=2e-3)
    assert len(source) == FRAMES and source.frame(3).T_given_camera[0, 3] == pytest.approx(0.3)


@pytest.mark.parametrize("name", ["associated.txt", "assoc.txt", "associate_with_groundtruth.txt"])
def test_associations_of_other_names_are_read(tmp_path: Path, name: str) -> None:
    listed(tmp_path, "{t} {path}", DATED)
    for part in ("rgb", "depth"):
        (tmp_path / f"{part}.txt").unlink()
    pose = " 0 1 2 3 0 0 0 1" * name.startswith("associate_with")
    lines = [f"{t:.6f} rgb/{n}.png {t:.6f} depth/{n}.png{pose}\n" for n, t in enumerate(DATED)]
    (tmp_path / name).write_text("".join(lines))
    source = open_source(tmp_path)
    assert len(list(source)) == FRAMES and source.timestamp_s(1) == pytest.approx(DATED[1], abs=1e-5)


def bag(
    folder: Path, topics: tuple[str, str], info: str, depth: str = "16UC1", frames: tuple[str, str] = ("c", "c"),
    change: Callable[[Recorder, float], None] = lambda recorder, t: None, ros1: bool = True,
) -> Path:  # fmt: skip
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    seen, recorder = scene(), Recorder(ros1)
    for color, depth_mm, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
        recorder.image(topics[0], t, color, "rgb8", frames[0])
        if depth == "16UC1":
            recorder.image(topics[1], t, depth_mm, depth, frames[1])
        else:
            data = encoded(depth_mm, "PNG") if depth == "png" else bytes(12) + bytes(range(40))
            recorder.compressed(topics[1], t, data, depth, frames[1])
    change(recorder, seen.times_s[0])
    if info:
        recorder.info(info, seen.times_s[0] + 0.01, (32, 24), FOCAL, frames[0])
    folder.mkdir(exist_ok=True)
    return recorder.write(folder / ("walk.bag" if ros1 else "walk"))


def zero_first(recorder: Recorder, t: float) -> None:
    recorder.info("/cam/color/camera_info", t, (32, 24), (0.0, 0.0, 0.0, 0.0), "c")


BAGS = {
    "camera_info below the image": (
        ("/drone/front/Scene", "/drone/front/DepthPlanar"),
        "/drone/front/Scene/camera_info",
    ),
    "camera_info elsewhere": (("/rgb_front/image", "/depth_front/image"), "/info_front/camera_info"),
    "topics without a slash": (("cam/color/image_raw", "cam/depth/image_raw"), "cam/color/camera_info"),
}


@pytest.mark.parametrize("kind", BAGS)
def test_cameras_of_topics_of_other_names(tmp_path: Path, kind: str) -> None:
    source = open_source(bag(tmp_path, *BAGS[kind]))
    assert source.camera.fx == FOCAL[0] and len(list(source)) == recordings.FRAMES


def test_a_camera_info_of_zeros_before_the_first_one_is_passed_over(tmp_path: Path) -> None:
    topics = "/cam/color/image_raw", "/cam/depth/image_raw"
    assert open_source(bag(tmp_path / "a", topics, "/cam/color/camera_info", change=zero_first)).camera.fx == FOCAL[0]
    with pytest.raises(SourceError, match=r"camera unknown: .*--fx PIXELS"):
        open_source(bag(tmp_path / "b", topics, "", change=zero_first))


def test_depth_that_was_recorded_by_the_plain_compressed_transport(tmp_path: Path) -> None:
    topics = "/cam/color/image_raw", "/cam/aligned_depth_to_color/image_raw/compressed"
    source = open_source(bag(tmp_path, topics, "/cam/color/camera_info", "png", ros1=False))
    assert np.allclose(source.frame(1).depth_m, scene().depths_mm[1] / 1000)


def test_depth_as_rvl_says_what_to_do(tmp_path: Path) -> None:
    topics = "/cam/color/image_raw", "/cam/depth/image_raw/compressedDepth"
    with pytest.raises(SourceError, match=r"encoded as 16UC1; compressedDepth rvl; .*republish RVL as PNG"):
        open_source(bag(tmp_path, topics, "/cam/color/camera_info", "16UC1; compressedDepth rvl"))


def test_topics_without_a_slash_can_be_given_with_and_without_one(tmp_path: Path) -> None:
    path = bag(tmp_path, ("cam/color/image_raw", "cam/depth/image_raw"), "cam/color/camera_info")
    for name in ("cam/color/image_raw", "/cam/color/image_raw"):
        assert len(open_source(path, color_topic=name)) == recordings.FRAMES


BASE = np.eye(4)
BASE[:3, :3], BASE[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.3, 0.02, 0.6]
LINK = np.eye(4)
LINK[:3, 3] = [0.25, 0.0, 0.6]


def test_the_truth_of_openloris_is_converted_from_the_base_to_the_colour_camera(tmp_path: Path) -> None:
    seen = sample()
    for part, images in (("color", seen.color), ("aligned_depth", seen.depth_mm)):
        for n in range(FRAMES):
            layouts.save(tmp_path / f"{part}/{n}.png", images[n])
        layouts.save_text(tmp_path / f"{part}.txt", "\n".join(f"{n / 30:.6f} {part}/{n}.png" for n in range(FRAMES)))
    truth = [layouts.tum_line(n / 30, seen.T_world_camera[n] @ se3.inverse(BASE)) for n in range(FRAMES)]
    layouts.save_text(tmp_path / "groundtruth.txt", "".join(truth))
    links = [
        ("base_link", "d400_link", LINK), ("d400_link", "d400_color_optical_frame", se3.inverse(LINK) @ BASE),
        ("base_link", "t265_link", np.eye(4)),
    ]  # fmt: skip
    text = "%YAML:1.0\n---\ntrans_matrix:\n"
    for parent, child, T in links:
        numbers = ", ".join(f"{value:.17g}" for value in T.ravel())
        text += f"   -\n      parent_frame: {parent}\n      child_frame: {child}\n      matrix: !!opencv-matrix\n"
        text += f"         rows: 4\n         cols: 4\n         dt: d\n         data: [ {numbers} ]\n"
    layouts.save_text(tmp_path / "trans_matrix.yaml", text)
    path = open_source(tmp_path, fx=30.0).truth()
    assert path is not None
    np.testing.assert_allclose(path.T_world_camera, seen.T_world_camera, atol=1e-6)
    (tmp_path / "trans_matrix.yaml").write_text(text.replace("d400_color", "d435_color"))
    with pytest.raises(SourceError, match=r"trans_matrix.yaml: no transform from base_link to d400_color"):
        open_source(tmp_path, fx=30.0)


@pytest.mark.parametrize("part", ["wide", "vga_wide"])
def test_arkitscenes_with_large_colour(tmp_path: Path, part: str) -> None:
    seen = sample((64, 48))
    for n in range(FRAMES):
        t = 306.508 + 0.1 * n
        layouts.save(tmp_path / f"{part}/41069021_{t:.3f}.png", seen.color[n])
        for kind, values in (
            ("lowres_depth", seen.depth_mm[n, ::2, ::2]),
            ("confidence", np.full((24, 32), 2, np.uint8)),
        ):
            layouts.save(tmp_path / f"{kind}/41069021_{t + 0.001 * (n % 2):.3f}.png", values)
        layouts.save_text(tmp_path / f"{part}_intrinsics/41069021_{t:.3f}.pincam", "64 48 50 50 31.5 23.5\n")
    source = open_source(tmp_path)
    assert len(list(source)) == FRAMES and source.camera.fx == 25.0
    assert source.origins["depth unit"] == ("1000 per metre", "defined by the format", "")


def test_formats_that_define_the_unit_do_not_call_it_assumed(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="Stray Scanner needs OpenCV")
    source = open_source(recordings.write_stray(tmp_path / "stray", scene()))
    assert source.origins["depth unit"].origin == "defined by the format"
    assert not any(line.startswith("depth unit") for line in source.assumptions)
    assert open_source(tmp_path / "stray", depth_scale=500).origins["depth unit"].origin == "given"
