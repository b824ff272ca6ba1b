"""Photos: colour of keyframes at the camera's own size, and the depth that goes with it."""

from pathlib import Path

import numpy as np
import pytest

from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame, Photo, enlarged_depth, photo_size
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.run_folder.submaps import DiskStore

WHOLE = Camera(64, 48, 60.0, 61.0, 31.0, 24.0)


def image(camera: Camera) -> np.ndarray:
    """Return a smooth image: colour depends on the ray, so every size and crop shows the same scene."""
    x, y = camera.rays()[..., 0], camera.rays()[..., 1]
    return (0.5 + 0.3 * np.stack([np.sin(4 * x), np.cos(5 * y), np.sin(3 * x + 2 * y)], -1)).astype(np.float32)


def frame(camera: Camera = WHOLE) -> Frame:
    depth_m = (2.0 + 0.5 * camera.rays()[..., 0]).astype(np.float32)
    return Frame(3, 0.5, image(camera), depth_m, camera)


def test_photos_are_wanted_only_if_they_are_larger_than_the_working_images() -> None:
    assert photo_size(WHOLE, 32, 0, 0) is None
    assert photo_size(WHOLE, 0, 0, 640) is None and photo_size(WHOLE, 64, 0, 640) is None
    assert photo_size(WHOLE, 32, 0, 32) is None and photo_size(WHOLE, 32, 0, 16) is None
    assert photo_size(WHOLE, 32, 0, 640) == photo_size(WHOLE, 32, 0, 64) == photo_size(WHOLE, 32, 0, 999) == (WHOLE, 0)
    assert photo_size(WHOLE, 16, 0, 32) == (WHOLE.prepared(32), 0)


def test_a_cropped_photo_shows_the_same_part_as_the_working_image() -> None:
    size = photo_size(WHOLE, 32, 2, 640)
    assert size == (WHOLE.prepared(64, 4), 4)
    photo = Photo.of(frame(), *size)
    assert photo.camera.share_seen_by(WHOLE.prepared(32, 2)) == WHOLE.prepared(32, 2).share_seen_by(photo.camera) == 1.0
    assert np.abs(photo.color() / 255.0 - image(photo.camera)).max() < 0.03


def test_a_photo_is_small_and_looks_the_same() -> None:
    photo = Photo.of(frame(), WHOLE)
    assert photo.jpeg.dtype == np.uint8 and photo.jpeg.nbytes < frame().color.size
    assert photo.color().shape == (48, 64, 3)
    assert np.sqrt(np.mean((photo.color() / 255.0 - frame().color) ** 2)) < 0.01
    assert np.array_equal(photo.jpeg, Photo.of(frame(), WHOLE).jpeg)


def test_a_photo_becomes_a_frame_of_any_camera_of_the_same_view() -> None:
    working = WHOLE.prepared(32)
    depth_m = frame(working).depth_m
    photo = Photo.of(frame(), WHOLE)
    for camera in (WHOLE, Camera(50, 40, 55.0, 55.0, 24.0, 20.0)):
        found = photo.frame(depth_m, working, camera)
        assert found.camera == camera
        inner = np.s_[2:-2, 2:-2]
        assert np.abs(found.color - image(camera))[inner].max() < 0.04
        assert np.abs(found.depth_m - frame(camera).depth_m)[inner].max() < 0.02


def test_enlarged_depth_is_exact_on_a_plane_and_mixes_no_surfaces() -> None:
    working = WHOLE.prepared(32)
    depth_m = frame(working).depth_m.copy()
    inner = np.s_[1:-1, 1:-1]
    assert np.abs(enlarged_depth(depth_m, working, WHOLE) - frame().depth_m)[inner].max() < 1e-5
    depth_m[:, 16:] = 4.0
    depth_m[5:8, 3:9] = 0.0
    found = enlarged_depth(depth_m, working, WHOLE)
    step = found[20, 28:36]
    assert ((step < 2.2) | (step == 4.0)).all(), "no depth between the two surfaces"
    assert not found[10:16, 6:18].any(), "no reading, no depth"
    assert found[9, 6:18].all() and found[16, 6:18].all(), "holes do not grow"


def test_depth_outside_the_working_image_is_unknown() -> None:
    cropped = WHOLE.prepared(32, 4)
    found = enlarged_depth(frame(cropped).depth_m, cropped, WHOLE)
    assert not found[:7].any() and not found[:, :7].any() and found[8:-8, 8:-8].all()


@pytest.mark.parametrize("kept", [True, False])
def test_photos_are_read_back_from_disk_one_at_a_time(tmp_path: Path, kept: bool) -> None:
    store, rng = DiskStore(tmp_path), np.random.default_rng(0)
    working = WHOLE.prepared(32)
    frames = [Frame(k, k, rng.random((48, 64, 3), np.float32), frame().depth_m, WHOLE) for k in range(3)]
    photos = [Photo.of(f, WHOLE) for f in frames]
    assert len({photo.jpeg.nbytes for photo in photos}) > 1
    pictures = [
        Picture(np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.float32), photo=photo if kept else None)
        for photo in photos
    ]
    store.save(Submap(0, GaussianField.empty(), (0, 1, 2), np.stack([np.eye(4)] * 3), working), pictures)
    for k, photo in enumerate(photos):
        back = store.picture(0, k).photo
        if kept:
            assert back is not None and np.array_equal(back.jpeg, photo.jpeg) and back.camera == photo.camera
        else:
            assert back is None
