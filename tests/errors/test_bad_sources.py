"""Errors in an input sequence: one line that says what is wrong, where, and what to do."""

import json

import numpy as np
import pytest
from PIL import Image

from sigmasplat.errors import SigmaSplatError
from sigmasplat.input.opening import formats
from sigmasplat.plugins.sources import open_source


def refusal(path, **options) -> str:
    """Open and read a bad sequence; return the error message."""
    with pytest.raises(SigmaSplatError) as caught:
        list(open_source(path, **options))
    message = str(caught.value)
    assert "\n" not in message and len(message) < 900
    return message


def calibrate(folder, **changes):
    fields = json.loads((folder / "calibration.json").read_text()) | changes
    (folder / "calibration.json").write_text(json.dumps({k: v for k, v in fields.items() if v is not None}))


def test_missing_folder(tmp_path):
    assert "no such folder" in refusal(tmp_path / "absent")


def test_a_file_instead_of_a_folder(tmp_path):
    (tmp_path / "notes.txt").write_bytes(b"x")
    assert "is a file of unknown format" in refusal(tmp_path / "notes.txt")


def test_unknown_format_lists_the_known_formats_and_the_content(tmp_path):
    (tmp_path / "notes.txt").write_bytes(b"x")
    message = refusal(tmp_path)
    for words in ("unknown format", "notes.txt", "docs/data.md", *(known.name for known in formats())):
        assert words in message


def test_empty_folder(tmp_path):
    assert "an empty folder" in refusal(tmp_path)


def test_rgb_only_download_without_the_list(tiny_tum):
    (tiny_tum / "depth.txt").unlink()
    message = refusal(tiny_tum)
    assert "no depth images in" in message and "depth.txt" in message and "RGB-only" in message


def test_rgb_only_download_with_the_list(tiny_tum):
    for path in (tiny_tum / "depth").iterdir():
        path.unlink()
    assert "RGB-only" in refusal(tiny_tum)


def test_colour_list_missing(tiny_tum):
    (tiny_tum / "rgb.txt").unlink()
    assert "rgb.txt" in refusal(tiny_tum)


def test_no_overlap_in_time_gives_both_spans(tiny_tum):
    (tiny_tum / "depth.txt").write_text("".join(f"{100 + i} depth/{i}.png\n" for i in range(4)))
    message = refusal(tiny_tum)
    assert "0.000 … 0.300 s" in message and "100.000 … 103.000 s" in message


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_truncated_image_is_skipped_by_name_and_raised_when_strict(tiny_tum, part):
    path = tiny_tum / part / "2.png"
    path.write_bytes(path.read_bytes()[:60])
    source = open_source(tiny_tum)
    assert [f.index for f in source] == [0, 1, 3]
    assert len(source.skipped) == 1 and str(path) in source.skipped[0] and "unreadable" in source.skipped[0]
    assert f"{part}/2.png" in refusal(tiny_tum, strict=True)


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
def test_a_corrupt_first_image_does_not_stop_the_rest(tiny_tum, content):
    (tiny_tum / "rgb/0.png").write_bytes(content)
    source = open_source(tiny_tum)
    assert [f.index for f in source] == [1, 2, 3] and "rgb/0.png" in source.skipped[0]


def test_flipped_bytes_inside_an_image(tiny_tum):
    path = tiny_tum / "rgb/1.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    assert len(list(open_source(tiny_tum))) == 3


def test_a_missing_image_is_skipped_by_name(tiny_tum):
    (tiny_tum / "depth/3.png").unlink()
    source = open_source(tiny_tum)
    assert len(list(source)) == 3 and "depth/3.png: the image is missing" in source.skipped[0]


def test_all_images_damaged(tiny_tum):
    for path in (tiny_tum / "rgb").iterdir():
        path.write_bytes(b"x")
    assert "no pair of colour and depth can be read" in refusal(tiny_tum)


def test_different_sizes_of_colour_and_depth(tiny_tum):
    for i in range(4):
        Image.fromarray(np.full((12, 16), 2000, np.uint16)).save(tiny_tum / f"depth/{i}.png")
    message = refusal(tiny_tum)
    assert "32×24" in message and "16×12" in message and "register depth to colour" in message


def test_calibration_for_another_size(tiny_tum):
    calibrate(tiny_tum, width=640, height=480)
    message = refusal(tiny_tum)
    assert "32×24" in message and "640×480" in message


def test_depth_zero_everywhere(tiny_tum):
    for i in range(4):
        Image.fromarray(np.zeros((24, 32), np.uint16)).save(tiny_tum / f"depth/{i}.png")
    assert "depth is zero" in refusal(tiny_tum)


def test_depth_in_one_frame_is_enough(tiny_tum):
    for i in (0, 1, 3):
        Image.fromarray(np.zeros((24, 32), np.uint16)).save(tiny_tum / f"depth/{i}.png")
    assert len(list(open_source(tiny_tum))) == 4


def test_a_colour_image_as_depth(tiny_tum):
    for i in range(4):
        Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(tiny_tum / f"depth/{i}.png")
    assert "not a depth image" in refusal(tiny_tum)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
@pytest.mark.parametrize("suffix", ["npy", "tiff"])
def test_float_depth_that_is_not_a_distance(tiny_tum, bad, suffix):
    depth = np.full((24, 32), 1.5, np.float32)
    depth[3, 4] = bad
    path = tiny_tum / f"depth/1.{suffix}"
    if suffix == "npy":
        np.save(path, depth)
    else:
        Image.fromarray(depth).save(path)
    (tiny_tum / "depth.txt").write_text((tiny_tum / "depth.txt").read_text().replace("1.png", path.name))
    source = open_source(tiny_tum)
    assert len(list(source)) == 3 and path.name in source.skipped[0]
    assert path.name in refusal(tiny_tum, strict=True)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.1 nan 0 0 0 0 0 1", "not finite"),
        ("0.1 0 0 inf 0 0 0 1", "not finite"),
        ("0.1 0 0 0 0 0 0 0", "not rigid"),
        ("0.1 0 0 0 0 0 0 2", "not rigid"),
        ("0.1 0 0 0 0 0 1", "found 7 values"),
        ("0.1 a b c 0 0 0 1", "expected numbers"),
    ],
)
def test_a_bad_ground_truth_pose_is_named_by_file_and_line(tiny_tum, line, words):
    (tiny_tum / "groundtruth.txt").write_text(f"# t\n0.0 0 0 0 0 0 0 1\n{line}\n")
    message = refusal(tiny_tum)
    assert "groundtruth.txt:3" in message and words in message


@pytest.mark.parametrize(
    ("line", "words"), [("0.5", "'timestamp path'"), ("x rgb/0.png", "numbers"), ("nan rgb/0.png", "finite")]
)
def test_a_bad_line_in_a_list_is_named(tiny_tum, line, words):
    (tiny_tum / "rgb.txt").write_text(line + "\n")
    message = refusal(tiny_tum)
    assert "rgb.txt:1" in message and words in message


def test_an_empty_list(tiny_tum):
    (tiny_tum / "rgb.txt").write_text("# nothing\n")
    assert "lists no images" in refusal(tiny_tum)


def test_camera_unknown(tiny_tum):
    (tiny_tum / "calibration.json").unlink()
    message = refusal(tiny_tum)
    assert "camera unknown" in message and "calibration.json" in message


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": None}, '"fx" is missing'),
        ({"fy": "wide"}, '"fy"'),
        ({"fx": -3.0}, "not a camera"),
        ({"depth_scale": 0}, '"depth_scale"'),
        ({"distortion": [1, 2]}, '"distortion"'),
        ({"distortion": [0.1, "a", 0, 0]}, '"distortion"'),
    ],
)
def test_a_bad_calibration_names_file_and_field(tiny_tum, changes, words):
    calibrate(tiny_tum, **changes)
    message = refusal(tiny_tum)
    assert "calibration.json" in message and words in message


@pytest.mark.parametrize("text", ["{", "[1, 2]", "\x00"])
def test_a_calibration_that_is_not_a_json_object(tiny_tum, text):
    (tiny_tum / "calibration.json").write_text(text)
    assert "calibration.json" in refusal(tiny_tum)


@pytest.mark.parametrize(
    "option",
    ["frames=0", "frames=x", "frames=--2", "speed=2", "rooms=0", "seed=-1", "width", "corridors", "corridor=", "seed"],
)
def test_a_bad_option_of_the_synthetic_room(option):
    assert "synthetic room" in refusal(f"synthetic:{option}")


@pytest.mark.parametrize("options", [{"stride": 0}, {"limit": -1}, {"stride": -1}])
def test_a_bad_stride_or_limit(tiny_tum, options):
    (name,) = options
    assert f"input.{name} must be " in refusal(tiny_tum, **options)
