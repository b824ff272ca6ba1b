"""Video, photos and stereo recordings hold no depth: the error says so and says where to read on."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources import open_source

COLOR = np.full((12, 16, 3), 90, np.uint8)
GREY = np.full((12, 16), 90, np.uint8)
DEPTH = np.full((12, 16), 2000, np.uint16)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")


def refusal(path: Path) -> str:
    with pytest.raises(SourceError) as caught:
        open_source(path)
    return str(caught.value)


def video(folder: Path) -> Path:
    write(folder / "VID_20260101.mp4")
    return folder / "VID_20260101.mp4"


def phone_recording(folder: Path) -> None:
    """A video and sensor readings, as recording apps of Android phones write them."""
    write(folder / "movie.mp4")
    write(folder / "gyro_accel.csv")


def photos(folder: Path) -> None:
    for i in range(3):
        save(folder / f"IMG_{i:04d}.JPG", COLOR)


def photos_in_a_subfolder(folder: Path) -> None:
    for i in range(3):
        save(folder / "DCIM" / "100ANDRO" / f"IMG_{i:04d}.jpg", COLOR)


def raw_photos(folder: Path) -> None:
    write(folder / "IMG_0001.HEIC")


def colmap(folder: Path) -> None:
    for i in range(3):
        save(folder / "images" / f"{i}.jpg", COLOR)
    write(folder / "sparse" / "0" / "cameras.bin")


def one_photo(folder: Path) -> Path:
    save(folder / "IMG_0001.jpg", COLOR)
    return folder / "IMG_0001.jpg"


def euroc(folder: Path) -> None:
    for camera in ("cam0", "cam1"):
        save(folder / "mav0" / camera / "data" / "1403636579763555584.png", GREY)
        write(folder / "mav0" / camera / "data.csv")


def kitti(folder: Path) -> None:
    for camera in ("image_2", "image_3"):
        save(folder / camera / "000000.png", COLOR)


def left_and_right(folder: Path) -> None:
    for camera in ("left", "right"):
        save(folder / camera / "000000.png", COLOR)


CASES = {
    video: "a video",
    phone_recording: "video: movie.mp4",
    photos: "(images in .)",
    photos_in_a_subfolder: "images in DCIM/100ANDRO",
    raw_photos: "(images in .)",
    colmap: "(images in images)",
    one_photo: "a single image",
    euroc: "(images in mav0/cam0/data, mav0/cam1/data)",
    kitti: "(images in image_2, image_3)",
    left_and_right: "(images in left, right)",
}


@pytest.mark.parametrize("layout", CASES, ids=lambda layout: layout.__name__)
def test_images_without_depth_are_named_with_a_link_to_the_documents(layout, tmp_path):
    path = layout(tmp_path) or tmp_path
    message = refusal(path)
    assert message.startswith(f"{path} holds images but no depth (") and CASES[layout] in message
    assert "RGB-D" in message and "docs/data.md#without-depth" in message
    assert "\n" not in message and len(message.replace(str(tmp_path), "")) < 250


def depth_under_another_name(folder: Path) -> None:
    save(folder / "frames" / "0.png", COLOR)
    save(folder / "range" / "0.png", DEPTH)


def depth_in_the_name(folder: Path) -> None:
    save(folder / "my_photos" / "0.png", COLOR)
    save(folder / "my_depth" / "0.png", GREY)


@pytest.mark.parametrize("layout", [depth_under_another_name, depth_in_the_name])
def test_a_recording_that_may_hold_depth_is_of_unknown_format(layout, tmp_path):
    message = refusal(layout(tmp_path) or tmp_path)
    assert "unknown format" in message and "no depth" not in message


def test_only_the_upper_levels_of_a_folder_are_searched(tmp_path):
    save(tmp_path / "a" / "b" / "c" / "d" / "0.png", COLOR)
    assert "unknown format" in refusal(tmp_path)


def test_a_folder_of_sequences_names_them_first(tiny_tum):
    write(tiny_tum.parent / "preview.mp4")
    shutil.copytree(tiny_tum, tiny_tum.parent / "zoo")
    assert f"holds sequences: {tiny_tum.name} (TUM: rgb.txt and depth.txt)" in refusal(tiny_tum.parent)
