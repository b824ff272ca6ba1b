"""The most likely mistakes with each data set: one line that says what is wrong and what to do."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from layouts import LAYOUTS, sample
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.sources import open_source

Damage = Callable[[Path], Path | None]


def without(*patterns: str) -> Damage:
    """Delete files and folders."""

    def damage(folder: Path) -> None:
        for path in [path for pattern in patterns for path in folder.glob(pattern)]:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def with_text(name: str, text: str) -> Damage:
    """Replace the text of a file."""

    def damage(folder: Path) -> None:
        path = next(iter(folder.glob(name)), folder / name)
        path.write_text(text)

    return damage


def redrawn(pattern: str, draw: Callable[[Image.Image], Image.Image]) -> Damage:
    """Replace images by others."""

    def damage(folder: Path) -> None:
        for path in folder.glob(pattern):
            with Image.open(path) as image:
                other = draw(image)
            other.save(path)

    return damage


def resized(pattern: str, size: tuple[int, int] = (20, 14)) -> Damage:
    """Make images another size, as a viewer or an exporter might have."""
    return redrawn(pattern, lambda image: image.resize(size, Image.Resampling.NEAREST))


def painted(pattern: str) -> Damage:
    """Replace depth by 8-bit colour images."""
    return redrawn(pattern, lambda image: Image.new("RGB", image.size, (90, 40, 10)))


def blank(pattern: str) -> Damage:
    """Set every depth pixel to 0."""
    return redrawn(pattern, lambda image: Image.fromarray(np.zeros(image.size[::-1], np.uint16)))


def renumbered(pattern: str) -> Damage:
    """Rename the images to the numbers of another recording."""

    def damage(folder: Path) -> None:
        for path in sorted(folder.glob(pattern)):
            name = re.sub(r"[0-9]+", lambda found: str(int(found[0]) + 500).zfill(len(found[0])), path.name, count=1)
            path.rename(path.with_name(name))

    return damage


def fields(name: str, change: Callable[[dict], object]) -> Damage:
    """Change the object in a JSON file."""

    def damage(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content))

    return damage


def packed(pattern: str, archive: str) -> Damage:
    """Replace files by an archive that is not unpacked."""

    def damage(folder: Path) -> None:
        without(pattern)(folder)
        (folder / archive).write_bytes(b"PK")

    return damage


def sequence_packed(folder: Path) -> Path:
    scene = folder.parent
    packed("seq-01", "seq-01.zip")(scene)
    return scene


def both(*damages: Damage) -> Damage:
    def damage(folder: Path) -> None:
        for each in damages:
            each(folder)

    return damage


def second_sequence(folder: Path) -> Path:
    shutil.copytree(folder, folder.parent / "seq-02")
    return folder.parent


def rendered_elsewhere(folder: Path) -> None:
    (folder / "dslr/undistorted_depths").rename(folder / "dslr/render_depth")


def text_depth(folder: Path) -> None:
    without("*")(folder)
    (folder / "scene_00_0000.depth").write_text("231.5 231.6")


def one_lost(folder: Path) -> None:
    renumbered("depth/*")(folder)
    (folder / "depth/508.png").unlink()


def another_time(folder: Path) -> None:
    for path in list(folder.glob("depth/*")):
        number, time_us = path.stem.split("-")
        path.rename(path.with_name(f"{number}-{int(time_us) + 10**9:012d}.png"))


def scaled(frame: dict) -> None:
    frame["transform_matrix"] = (2 * np.eye(4)).tolist()


SCALED_ROWS = "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n"
LISTS = ("RGB-only download", "no depth images in")
MISTAKES: dict[str, dict[str, tuple[Damage, tuple[str, ...]]]] = {
    "scannet": {
        "not extracted": (packed("*", "scene0000_00.sens"), ("not extracted", "SensReader")),
        "only colour": (without("depth"), (*LISTS, "depth/*.png")),
        "no matrices": (without("intrinsic"), ("camera unknown", "calibration.json", "--fx")),
        "no matrix of depth": (without("intrinsic/*_depth.txt"), ("depth camera's matrix is missing",)),
        "a truncated matrix": (with_text("intrinsic/i*_color.txt", "1170 0 647"), ("intrinsic_color.txt", "4×4")),
        "other frames in depth": (renumbered("depth/*"), ("no number in common", "one recording")),
        "a pose that is not rigid": (with_text("pose/7.txt", SCALED_ROWS), ("7.txt", "not a rigid")),
        "depth as a colour image": (painted("depth/*"), ("not a depth image",)),
    },
    "scannet_preprocessed": {
        "only colour": (without("depth"), (*LISTS, "depth/*.TIFF")),
        "poses of a part": (with_text("gt_pose.txt", "1.0 0 0 0 0 0 0 1\n"), ("gt_pose.txt", "1 poses", "truncated")),
        "a pose that is not rigid": (with_text("gt_pose.txt", "1.0 0 0 0 0 0 0 2\n" * 9), ("gt_pose.txt:1", "rigid")),
        "a truncated matrix": (with_text("intrinsic.txt", "1170 0 647"), ("intrinsic.txt", "4×4")),
        "other frames in depth": (renumbered("depth/*"), ("no number in common", "one recording")),
        "images of another size": (resized("rgb/*.png", (40, 30)), ("40×30", "32×24", "register")),
        "depth as a colour image": (painted("depth/*"), ("not a depth image",)),
    },
    "scannetpp": {
        "images not undistorted": (without("dslr/undistorted_images"), ("no undistorted_images/", "dslr.undistort")),
        "depth of the fisheye": (rendered_elsewhere, ("no undistorted_depths/", "render_depth")),
        "a list of another scene": (
            with_text("dslr/train_test_lists.json", '{"train": ["DSC09999.JPG"]}'), ("DSC09999.JPG", "not among"),
        ),
        "images downscaled": (resized("dslr/undistorted_*/*"), ("20×14", "32×24", "calibration")),
        "the fisheye's transforms": (
            fields("dslr/nerfstudio/transforms_undistorted.json", lambda f: f.update(camera_model="OPENCV_FISHEYE")),
            ("OPENCV_FISHEYE", "undistort"),
        ),
        "transforms damaged": (with_text("dslr/nerfstudio/transforms_undistorted.json", "{"), ("JSON",)),
    },
    "seven_scenes": {
        "not unzipped": (sequence_packed, ("seq-01.zip", "unpack it first")),
        "a scene with several sequences": (second_sequence, ("holds sequences", "seq-01", "seq-02", "give the path")),
        "only colour": (without("*.depth.png"), LISTS),
        "a truncated pose": (with_text("frame-000001.pose.txt", "1 0 0"), ("frame-000001.pose.txt", "4×4")),
        "images made smaller": (resized("*.png", (320, 240)), ("320×240", "640×480", "calibration")),
        "depth as a colour image": (painted("*.depth.png"), ("not a depth image",)),
    },
    "icl_nuim": {
        "text depth": (text_depth, ("text depth", "frei_png")),
        "depth not downloaded": (without("depth"), ("no pair of colour and depth", "is missing")),
        "a damaged list": (with_text("associations.txt", "1 rgb/1.png\n"), ("associations.txt:1", "expected")),
        "an empty list": (with_text("associations.txt", "# nothing\n"), ("lists no images",)),
        "a truncated pose": (with_text("*.gt.freiburg", "1 0 0 0\n"), ("gt.freiburg:1", "tx ty tz")),
        "depth blank": (blank("depth/*"), ("depth is zero",)),
    },
    "open3d": {
        "only colour": (without("depth"), LISTS),
        "only depth": (without("color"), ("no colour images in",)),
        "no intrinsics": (
            fields("camera_intrinsic.json", lambda f: f.pop("intrinsic_matrix")), ("intrinsic_matrix", "9 numbers"),
        ),
        "intrinsics for another size": (
            fields("camera_intrinsic.json", lambda f: f.update(width=640, height=400)), ("32×24", "640×400"),
        ),
        "a truncated log": (with_text("trajectory.log", "0 0 1\n1 0 0 0\n"), ("trajectory.log", "truncated")),
        "a log that is not rigid": (with_text("trajectory.log", "0 0 1\n" + SCALED_ROWS), ("log:1", "not a rigid")),
        "other frames in depth": (renumbered("depth/*"), ("no number in common",)),
    },
    "redwood": {
        "only colour": (without("depth"), LISTS),
        "another recording's depth": (
            another_time,
            ("no colour image of", "has depth within"),
        ),
        "images made smaller": (resized("*/*.[jp][pn]g", (320, 240)), ("320×240", "640×480")),
        "a log of words": (with_text("00021.log", "0 0 1\n1 0 0 x\n"), ("00021.log:2", "expected numbers")),
        "depth as a colour image": (painted("depth/*"), ("not a depth image",)),
    },
    "bonn": {
        "only colour": (without("depth", "depth.txt"), LISTS),
        "an empty depth list": (with_text("depth.txt", "# none\n"), ("depth.txt", "lists no images")),
        "truncated ground truth": (with_text("groundtruth.txt", "1 2 3\n"), ("groundtruth.txt:1", "tx ty tz")),
        "empty ground truth": (with_text("groundtruth.txt", "# none\n"), ("holds no poses",)),
        "images made smaller": (resized("*/*.png", (320, 240)), ("320×240", "640×480")),
    },
    "nerfstudio": {
        "only colour": (
            both(
                fields("transforms.json", lambda f: [frame.pop("depth_file_path") for frame in f["frames"]]),
                without("depth*"),
            ),
            ("depth_file_path", "export"),
        ),
        "several cameras": (
            fields("transforms.json", lambda f: f["frames"][1].update(w=55)), ("several cameras", "w 32 and 55"),
        ),
        "a fisheye": (fields("transforms.json", lambda f: f.update(camera_model="OPENCV_FISHEYE")), ("undistort",)),
        "no focal length": (fields("transforms.json", lambda f: f.pop("fl_x")), ("fl_x", "missing")),
        "a scaled world": (fields("transforms.json", lambda f: scaled(f["frames"][0])), ("not a rigid", "frame_10")),
        "no frames": (fields("transforms.json", lambda f: f.pop("frames")), ('no list "frames"',)),
        "images moved": (without("images"), ("no pair of colour and depth", "is missing")),
        "not JSON": (with_text("transforms.json", "frames: []"), ("transforms.json", "JSON")),
    },
    "plain": {
        "no camera": (without("calibration.json"), ("camera unknown", "--fx")),
        "only colour": (without("depth"), ("holds images but no depth", "docs/data.md#without-depth")),
        "an empty depth folder": (without("depth/*"), LISTS),
        "only depth": (without("color"), ("no colour images in",)),
        "sizes differ": (resized("depth/*"), ("20×14", "32×24", "depth_camera")),
        "a missing frame and different names": (
            one_lost,
            ("no name, time or number in common", "rgb.txt"),
        ),
        "depth as a colour image": (painted("depth/*"), ("not a depth image",)),
        "depth blank": (blank("depth/*"), ("depth is zero",)),
    },
}  # fmt: skip
TABLE = [
    pytest.param(name, damage, words, id=f"{name}: {mistake}")
    for name, mistakes in MISTAKES.items()
    for mistake, (damage, words) in mistakes.items()
]


@pytest.mark.parametrize(("name", "damage", "words"), TABLE)
def test_a_mistake_gives_one_clear_line(name, damage, words, tmp_path):
    layout = LAYOUTS[name]
    folder = layout.write(tmp_path, sample(layout.size))
    given = damage(folder) or folder
    with pytest.raises(SigmaSplatError) as caught:
        list(open_source(given, strict=True))
    message = str(caught.value)
    assert "\n" not in message and len(message.replace(str(tmp_path), "")) < 350
    for word in words:
        assert word in message


def test_every_format_has_five_mistakes():
    assert all(len(mistakes) >= 5 for mistakes in MISTAKES.values())
    assert {"tum", "replica"} == LAYOUTS.keys() - MISTAKES.keys(), "tested in test_bad_sources.py"
