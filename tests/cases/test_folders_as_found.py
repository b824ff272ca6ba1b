"""Folders as other programs write them: names of other words, colour and depth in one folder, recordings inside another
folder, archives and recordings of other programs, depth with one channel more."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import layouts
from layouts import FRAMES, SMALL_CAMERA, Sample, opengl, sample, save, save_text
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import format_of, open_source

CALIBRATION = json.dumps(vars(SMALL_CAMERA) | {"depth_scale": 1000.0})


def pairs(folder: Path, color: str, depth: str, change: Callable[[np.ndarray], np.ndarray] = np.asarray) -> Sample:
    """Write the images of each frame under names with its number, and the camera."""
    seen = sample()
    for n in range(FRAMES):
        save(folder / color.format(n), seen.color[n])
        place, values = folder / depth.format(n), change(seen.depth_mm[n])
        place.parent.mkdir(parents=True, exist_ok=True)
        np.save(place, values) if place.suffix == ".npy" else save(place, values)
    save_text(folder / "calibration.json", CALIBRATION)
    return seen


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("RGB/{:04d}.png", "Depth/{:04d}.png"), ("JPEGImages/{}.jpg", "depth/{}.png"),
        ("image_left/{:06d}_left.png", "depth_left/{:06d}_left_depth.png"),
        ("color_raw/{}.png", "aligned_depth/{}.png"),
        ("rgb/Camera_0/rgb_{:05d}.jpg", "depth/Camera_0/depth_{:05d}.png"),
        ("{:05d}-color.png", "{:05d}-depth.png"), ("left{:06d}.png", "depth{:06d}.png"),
        ("desk_1_{}.png", "desk_1_{}_depth.png"),
        ("rec_Color_16333333{:02d}.3333.png", "rec_Depth_16333333{:02d}.3433.png"),
    ],
)  # fmt: skip
def test_folders_and_names_of_other_words_are_read(tmp_path: Path, color: str, depth: str) -> None:
    seen = pairs(tmp_path, color, depth)
    source = open_source(tmp_path)
    assert format_of(tmp_path).name == "plain folder" and len(source) == FRAMES
    assert np.allclose(source.frame(2).depth_m, seen.depth_mm[2] / 1000)


def test_images_that_are_neither_colour_nor_depth_are_left_out(tmp_path: Path) -> None:
    pairs(tmp_path, "color{:04d}.png", "depth{:04d}.png")
    for n in range(FRAMES):
        save(tmp_path / f"ir{n:04d}.png", sample().depth_mm[n])
        save(tmp_path / f"depth_vis{n:04d}.png", sample().color[n])
    source = open_source(tmp_path)
    assert len(source) == FRAMES and source.image_name(0) == "color0000.png"


def test_several_folders_of_a_kind_are_not_guessed(tmp_path: Path) -> None:
    for part in ("a", "b"):
        pairs(tmp_path, f"color_{part}/{{}}.png", f"depth_{part}/{{}}.png")
    with pytest.raises(SourceError, match=r"unknown format: .*found calibration.json, color_a/, color_b/"):
        open_source(tmp_path)


@pytest.mark.parametrize("axis", [0, 2])
def test_depth_with_one_channel_is_an_image(tmp_path: Path, axis: int) -> None:
    seen = pairs(
        tmp_path, "rgb/{}.png", "depth/{}.npy", lambda mm: np.expand_dims((mm / 1000).astype(np.float32), axis)
    )
    assert np.allclose(open_source(tmp_path).frame(1).depth_m, seen.depth_mm[1] / 1000)


def test_a_recording_in_a_folder_of_its_own_is_found_and_said(tmp_path: Path) -> None:
    pairs(tmp_path / "walk/walk", "rgb/{}.png", "depth/{}.png")
    source = open_source(tmp_path / "walk")
    assert source.name == "walk" and len(source) == FRAMES
    assert source.origins["recording"] == (str(tmp_path / "walk/walk"), f"the only one in {tmp_path / 'walk'}", "")


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("walk.zip", "an archive; unpack it first"), ("fr1_xyz.tgz", "an archive; unpack it first"),
        ("walk.tar.gz", "an archive; unpack it first"), ("walk.mkv", "azure_kinect_mkv_reader.py"),
        ("HD720.svo", "ZED_SVO_Export"), ("dyson_lab.klg", "export it as images"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("inside", [False, True])
def test_what_must_be_unpacked_or_extracted_first_is_said(tmp_path: Path, name: str, remedy: str, inside: bool) -> None:
    (tmp_path / name).write_bytes(bytes(99))
    with pytest.raises(SourceError, match=remedy) as refused:
        open_source(tmp_path if inside else tmp_path / name)
    assert str(tmp_path / name) in str(refused.value) and "give the folder of the images" in str(refused.value)


@pytest.mark.parametrize("ending", ["heic", "mp4"])
def test_colour_in_other_files_says_how_to_convert_it(tmp_path: Path, ending: str) -> None:
    pairs(tmp_path, "color/{}.jpg", "depth/{}.png")
    for path in sorted(tmp_path.glob("color/*")):
        path.rename(path.with_suffix(f".{ending}"))
    with pytest.raises(SourceError, match=r"no colour images in .*convert other images to JPEG, a video with: ffmpeg"):
        open_source(tmp_path)


def transforms(folder: Path, **more: object) -> Sample:
    seen = pairs(folder, "images/{:05d}.png", "depths/{:05d}.png")
    (folder / "calibration.json").unlink()
    frames = [
        {"file_path": f"images/{n:05d}.png", "transform_matrix": opengl(seen.T_world_camera[n])} for n in range(FRAMES)
    ]
    save_text(folder / "transforms.json", layouts.transforms(SMALL_CAMERA, frames, **more))
    return seen


def test_depth_beside_a_transforms_json_that_does_not_name_it_is_paired_by_name(tmp_path: Path) -> None:
    seen = transforms(tmp_path)
    source = open_source(tmp_path)
    assert format_of(tmp_path).name == "nerfstudio" and source.origins["pairs"].value == "by name"
    assert np.allclose(source.frame(3).depth_m, seen.depth_mm[3] / 1000)
