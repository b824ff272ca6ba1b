"""Lists, poses, bags and databases as people have them: read if their meaning is clear, else named with a remedy."""

import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bag_recordings import CAMERA_TOPICS, FOCAL, Recorder, aligned
from command_line import exit_code
from recordings import scene
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.sources import open_source

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
POSES = "".join(f"{i / 10:.3f} {i} 0 0.5 0 0 0.6 0.8\n" for i in range(4))


def case(name: str) -> Path:
    if not (CASES / name).is_dir():
        pytest.skip(f"no {CASES / name}")
    return CASES / name


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(SigmaSplatError) as caught:
        open_source(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def rows(change: Callable[[int, str], str]) -> str:
    return "".join(change(i, line) + "\n" for i, line in enumerate(POSES.splitlines()))


SAME_POSES = {
    "id after": rows(lambda i, line: f"{line} {i + 1}"),
    "id before": rows(lambda i, line: f"{i + 1} {line}"),
    "a header": "timestamp tx ty tz qx qy qz qw\n" + POSES,
    "commas and a header": "time,x,y,z,qx,qy,qz,qw,id\n" + rows(lambda i, line: f"{line} {i}".replace(" ", ",")),
    "w first": "#timestamp, p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z []\n"
    + rows(lambda i, line: f"{i / 10:.3f}, {i}, 0, 0.5, 0.8, 0, 0, 0.6"),
}


@pytest.mark.parametrize("text", SAME_POSES.values(), ids=SAME_POSES)
def test_near_misses_of_tum_text_are_the_same_poses(tiny_tum: Path, text: str) -> None:
    given = tiny_tum / "given.txt"
    given.write_text(POSES)
    expected = [frame.T_given_camera for frame in open_source(tiny_tum, poses=str(given))]
    given.write_text(text)
    found = [frame.T_given_camera for frame in open_source(tiny_tum, poses=str(given))]
    assert len(found) == 4 and np.allclose(found, expected)
    shutil.copy(given, tiny_tum / "groundtruth.txt")
    truth = open_source(tiny_tum).truth()
    assert truth is not None and np.allclose(truth.T_world_camera, expected)


def test_a_column_that_is_no_id_is_refused(tiny_tum: Path) -> None:
    given = tiny_tum / "given.txt"
    given.write_text(rows(lambda i, line: f"{line} 0.9{i}"))
    assert "found 9 values; remove the columns that are none of these" in refusal(tiny_tum, poses=str(given))
    given.write_text(rows(lambda i, line: f"{line} 1 2"))
    assert "with no more columns" in refusal(tiny_tum, poses=str(given))


def test_case_20_default_export_of_rtabmap() -> None:
    folder = case("20-poses-with-an-id")
    found = [frame.T_given_camera for frame in open_source(folder / "rec", poses=str(folder / "poses_id.txt"))]
    truth = open_source(folder / "rec").truth()
    assert truth is not None and len(found) == 20 and np.allclose(found, truth.T_world_camera, atol=1e-5)


def listed(folder: Path, name: str, change: Callable[[str], str], newline: str = "\n") -> None:
    lines = [line.split() for line in (folder / name).read_text().splitlines() if line[0] != "#"]
    (folder / name).write_bytes("".join(f"{t} {change(path)}{newline}" for t, path in lines).encode())


PATHS: dict[str, Callable[[str], str]] = {
    "backslashes": lambda path: path.replace("/", "\\"),
    "with a dot": lambda path: ".\\" + path.replace("/", "\\"),
    "of another computer": lambda path: "C:\\data\\my run\\" + path.replace("/", "\\"),
    "of another home": lambda path: "/home/bob/run 1/" + path,
    "in quotes": lambda path: f'"{path}"',
    "with a comment": lambda path: f"{path} # later",
}


@pytest.mark.parametrize("change", PATHS.values(), ids=PATHS)
def test_paths_of_lists(tiny_tum: Path, change: Callable[[str], str]) -> None:
    for name in ("rgb.txt", "depth.txt"):
        listed(tiny_tum, name, change, "\r\n")
    source = open_source(tiny_tum)
    assert len(source) == 4 and len(list(source)) == 4


@pytest.mark.parametrize("name", ["a#1", "a #1", "a, b", "two  words"])
def test_any_name_of_a_file_survives(tiny_tum: Path, name: str) -> None:
    for part in ("rgb", "depth"):
        for path in sorted((tiny_tum / part).iterdir()):
            path.rename(path.with_name(f"{name}{path.name}"))
        listed(tiny_tum, f"{part}.txt", lambda path: path.replace("/", f"/{name}"))
    assert [frame.index for frame in open_source(tiny_tum)] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["a#1 ", "a, b"])
def test_associations_have_such_names_too(tiny_tum: Path, name: str) -> None:
    lines = []
    for i in range(4):
        for part in ("rgb", "depth"):
            (tiny_tum / f"{part}/{i}.png").rename(tiny_tum / f"{part}/{name}{i}.png")
        lines.append(f"{i} depth\\{name}{i}.png {i} rgb\\{name}{i}.png\n")
    for part in ("rgb.txt", "depth.txt"):
        (tiny_tum / part).unlink()
    (tiny_tum / "associations.txt").write_text("".join(lines))
    source = open_source(tiny_tum)
    assert len(list(source)) == 4 and source.origins["times"].origin == "assumed"


def test_a_list_of_missing_files_names_the_first(tiny_tum: Path) -> None:
    listed(tiny_tum, "depth.txt", lambda path: path.replace("/", "\\x"))
    message = refusal(tiny_tum)
    assert f"{tiny_tum}/depth/x0.png" in message and "correct its paths" in message and "RGB-only" not in message


def test_case_22_lists_from_windows() -> None:
    assert len(list(open_source(case("22-lists-from-windows") / "rec"))) == 20


def database(path: Path, *tables: str) -> Path:
    with sqlite3.connect(path) as file:
        for table in tables:
            file.execute(f"CREATE TABLE {table} (id INTEGER)")
    file.close()
    return path


@pytest.mark.parametrize("name", ["map.db", "map.db3"])
def test_a_database_of_rtabmap_is_named(tmp_path: Path, name: str) -> None:
    path = database(tmp_path / name, "Node", "Data", "Info")
    message = refusal(path)
    assert f"{path} is a database of RTAB-Map" in message and f"rtabmap-export --images {path}" in message
    if name == "map.db":
        assert "RTAB-Map" in refusal(tmp_path)


def test_another_database_is_named_by_its_tables(tmp_path: Path) -> None:
    message = refusal(database(tmp_path / "photos.sqlite", "pictures", "albums"))
    assert "an SQLite file, but not a ROS 2 bag (tables albums, pictures)" in message


def test_case_11_by_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("run", str(case("11-sqlite-of-another-program") / "map.db")) == 2
    assert "a database of RTAB-Map" in capsys.readouterr().err


COLOR, DEPTH = CAMERA_TOPICS


def stored(encoding: str, topic: str = COLOR) -> Callable[[Path], Path]:
    """Write a bag whose colour is one patch of (200, 80, 40), in an encoding, beside depth."""

    def write(path: Path) -> Path:
        seen, patch = scene(), np.zeros((24, 32, 3), np.uint8)
        patch[:] = (200, 80, 40)
        if encoding in ("yuv422", "uyvy", "yuyv", "yuv422_yuy2"):
            y, u, v = 112, 93, 184  # ITU-R BT.601, 16 to 235, computed by hand
            pair = (u, y, v, y) if encoding in ("yuv422", "uyvy") else (y, u, y, v)
            image = np.tile(np.array(pair, np.uint8).reshape(2, 2), (24, 16, 1))
        elif encoding.startswith("bayer"):
            channel = np.array([["rgb".index(c) for c in pair] for pair in (encoding[6:8], encoding[8:10])])
            image = np.take_along_axis(patch, np.tile(channel, (12, 16))[..., None], -1)[..., 0]
        else:
            image = {"bgra8": patch[..., [2, 1, 0, 0]], "rgba8": patch[..., [0, 1, 2, 2]],
                     "rgb16": patch.astype(np.uint16) * 257, "16UC1": patch[..., 0].astype(np.uint16) * 257,
                     "mono16": patch[..., 0].astype(np.uint16) * 257}.get(encoding, patch[..., 0])  # fmt: skip
        recorder = Recorder()
        for depth, t in zip(seen.depths_mm, seen.times_s, strict=True):
            recorder.image(topic, t, np.ascontiguousarray(image), encoding, "optical")
            recorder.image(DEPTH, t, depth, "16UC1", "optical")
        recorder.info(topic.rpartition("/")[0] + "/camera_info", seen.times_s[0], (32, 24), FOCAL, "optical")
        return recorder.write(path / "bag")

    return write


@pytest.mark.parametrize(
    "encoding",
    ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8", "bgra8",
     "rgba8", "rgb16"],
)  # fmt: skip
def test_encodings_of_colour(tmp_path: Path, encoding: str) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    color = next(iter(open_source(stored(encoding)(tmp_path)))).color[4:-4, 4:-4] * 255
    assert np.abs(color - (200, 80, 40)).max() < 6


@pytest.mark.parametrize(("encoding", "named"), [("mono8", False), ("8UC1", False), ("mono16", True), ("16UC1", True)])
def test_gray_is_taken_alone_and_infrared_if_it_is_named(tmp_path: Path, encoding: str, named: bool) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    bag = stored(encoding, "/ir/image")(tmp_path)
    if named:
        message = refusal(bag)
        assert f"/ir/image is encoded as {encoding}" in message and "--color-topic NAME" in message
    source = open_source(bag, color_topic="/ir/image" if named else "")
    assert np.abs(next(iter(source)).color * 255 - 200).max() < 1


def test_colour_ranks_above_gray_and_confidence_is_no_image(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    seen = scene()
    recorder = aligned(Recorder(), seen)
    for depth, t in zip(seen.depths_mm, seen.times_s, strict=True):
        recorder.image("/infra1/image_rect", t, np.zeros_like(depth, np.uint8), "mono8", "optical")
    assert next(iter(open_source(recorder.write(tmp_path / "both")))).color.max() > 0
    only = Recorder()
    for depth, t in zip(seen.depths_mm, seen.times_s, strict=True):
        only.image("/camera/confidence", t, np.zeros_like(depth, np.uint8), "mono8", "optical")
        only.image(DEPTH, t, depth, "16UC1", "optical")
    assert "/camera/confidence is encoded as mono8" in refusal(only.write(tmp_path / "only"))


@pytest.mark.parametrize(("folder", "topic"), [("rec", ""), ("rec", "/right/image_rect"), ("yuyv", "")])
def test_case_18_gray_camera(folder: str, topic: str) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    assert len(list(open_source(case("18-gray-camera-bag") / folder, color_topic=topic))) in (5, 15)


def follow(message: str, name: str) -> dict[str, float]:
    return {name: float(re.findall(rf"--set input\.{name}=([-.0-9]+)", message)[0])}


def delayed(folder: Path, delay_s: float, step_s: float = 1 / 15, frames: int = 20, lost: int = -1) -> Path:
    """Make the lists of a recording whose depth is stamped late; the depth of frame `lost` is missing."""
    for part, late_s in (("rgb", 0.0), ("depth", delay_s)):
        kept = [i for i in range(frames) if part == "rgb" or i != lost]
        lines = [f"{100 + i * step_s + late_s + 0.001 * (i % 3):.6f} {part}/{i % 4}.png\n" for i in kept]
        (folder / f"{part}.txt").write_text("".join(lines))
    return folder


@pytest.mark.parametrize(
    ("delay_s", "step_s", "lost"),
    [(0.03, 1 / 15, -1), (-0.03, 1 / 15, -1), (0.04, 1 / 15, -1), (0.12, 0.2, 7), (7200.0, 0.1, -1)],
)
def test_a_constant_delay_is_named_and_its_remedies_work(
    tiny_tum: Path, delay_s: float, step_s: float, lost: int
) -> None:
    message = refusal(delayed(tiny_tum, delay_s, step_s, lost=lost))
    remedy = follow(message, "depth_delay_s")
    assert remedy["depth_delay_s"] == pytest.approx(delay_s, abs=0.0015)
    source = open_source(tiny_tum, **remedy)
    assert len(source) == 20 - (lost >= 0) and abs(source.frame(3).depth_late_s) < 0.002
    assert f"depth stamped {remedy['depth_delay_s']:g} s late" in source.origins["pairs"].value
    if abs(delay_s) < step_s / 2:
        source = open_source(tiny_tum, **follow(message, "max_gap_s"))
        assert len(source) == 20 - (lost >= 0) and source.frame(3).depth_late_s == pytest.approx(delay_s, abs=0.002)


def test_most_frames_lost_to_a_delay_is_an_error_and_a_wrong_delay_names_the_whole(tiny_tum: Path) -> None:
    delayed(tiny_tum, 0.03)
    lines = (tiny_tum / "depth.txt").read_text().splitlines(True)
    lines[:3] = [f"{100 + i / 15:.6f} depth/{i}.png\n" for i in range(3)]
    (tiny_tum / "depth.txt").write_text("".join(lines))
    message = refusal(tiny_tum)
    assert message.startswith("only 3 colour images of") and follow(message, "depth_delay_s")["depth_delay_s"] == 0.03
    message = refusal(delayed(tiny_tum, 0.03), depth_delay_s=-0.005)
    assert follow(message, "depth_delay_s")["depth_delay_s"] == pytest.approx(0.03, abs=0.0015)


def test_times_without_a_constant_delay_and_slow_depth_name_none(tiny_tum: Path) -> None:
    delayed(tiny_tum, 0.0)
    lines = (tiny_tum / "depth.txt").read_text().splitlines(True)
    (tiny_tum / "depth.txt").write_text("".join(lines[::4]))
    assert len(open_source(tiny_tum)) == 5
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(200, 220, 20))
    (tiny_tum / "depth.txt").write_text("".join(f"{t:.6f} depth/0.png\n" for t in times))
    message = refusal(tiny_tum)
    assert "are both from one recording?" in message and "depth_delay_s" not in message


def test_names_of_redwood_with_a_delay(tmp_path: Path, tiny_tum: Path) -> None:
    for part, ending, late_us in (("rgb", "png", 0), ("depth", "png", 40_000)):
        (tmp_path / "redwood" / part).mkdir(parents=True)
        for i in range(8):
            name = f"{i + 1:07d}-{100_000 * i + late_us + 10**9:012d}.{ending}"
            shutil.copy(tiny_tum / part / f"{i % 4}.png", tmp_path / "redwood" / part / name)
    options = {"fx": 30.0, "cx": 15.5, "cy": 11.5, "calibration": str(tiny_tum / "calibration.json")}
    message = refusal(tmp_path / "redwood", **options)
    assert len(open_source(tmp_path / "redwood", **options, **follow(message, "depth_delay_s"))) == 8


def test_case_19_by_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    folder = case("19-depth-30-ms-late-bag") / "rec"
    assert exit_code("inspect", str(folder)) == 2
    message = capsys.readouterr().err
    assert "--set input.depth_delay_s=0.030" in message and "--set input.max_gap_s=" in message
    for name in ("depth_delay_s", "max_gap_s"):
        source = open_source(folder, **follow(message, name))
        assert len(source) == 30 and source.origins["pairs"].origin == "read from the bag"


def test_openloris_names_and_unit_are_read(tmp_path: Path) -> None:
    for part in ("color", "aligned_depth"):
        (tmp_path / part).mkdir()
        lines = [f"{n / 30:.6f} {part}/{n}.png" for n in range(2)]
        (tmp_path / f"{part}.txt").write_text("\n".join(lines))
    for n in range(2):
        Image.fromarray(np.full((24, 32, 3), 90 + n, np.uint8)).save(tmp_path / f"color/{n}.png")
        Image.fromarray(np.full((24, 32), 1500, np.uint16)).save(tmp_path / f"aligned_depth/{n}.png")
    (tmp_path / "depth.txt").write_text("0.0 depth/0.png\n")
    source = open_source(tmp_path, fx=30.0)
    assert len(source) == 2 and float(source.frame(1).depth_m.max()) == pytest.approx(1.5)
