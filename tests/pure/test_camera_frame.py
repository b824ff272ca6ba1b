"""The camera and the frame: rays survive resizing, bad images are refused, depth mixes no surfaces."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.errors import ConfigError, SourceError

CAMERA = Camera(8, 6, 7.0, 6.5, 3.2, 2.9)


def frame(camera: Camera = CAMERA, seed: int = 0) -> Frame:
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    color, depth = rng.uniform(0, 1, (*size, 3)), rng.uniform(0.05, 9.0, size)
    return Frame(3, 0.5, color.astype(np.float32), depth.astype(np.float32), camera)


def test_rays_go_through_pixel_centres_at_whole_numbers() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (6, 8, 3) and rays.dtype == np.float32
    np.testing.assert_allclose(rays[4, 5], [(5 - 3.2) / 7.0, (4 - 2.9) / 6.5, 1.0], rtol=1e-6)


def test_a_resized_camera_keeps_the_edges_of_the_image() -> None:
    """The outer edges of the corner pixels lie on the same rays at every size."""
    for size in [(4, 3), (16, 12), (2, 2), (24, 6)]:
        small = CAMERA.resized(*size)
        for c in (CAMERA, small):
            assert (c.width, c.height) == (size if c is small else (8, 6))
        for old, new in ((-0.5, -0.5), (8 - 0.5, size[0] - 0.5)):
            assert (new - small.cx) / small.fx == pytest.approx((old - CAMERA.cx) / CAMERA.fx)
        for old, new in ((-0.5, -0.5), (6 - 0.5, size[1] - 0.5)):
            assert (new - small.cy) / small.fy == pytest.approx((old - CAMERA.cy) / CAMERA.fy)


def test_half_the_size_looks_through_the_middle_of_four_pixels() -> None:
    cells = CAMERA.rays().reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(CAMERA.resized(4, 3).rays(), cells, atol=1e-6)
    assert CAMERA.resized(8, 6) is CAMERA


def test_an_impossible_camera_is_refused() -> None:
    for numbers in [(0, 6, 7.0, 7.0), (8, -1, 7.0, 7.0), (8, 6, 0.0, 7.0), (8, 6, 7.0, -7.0), (8, 6, np.nan, 7.0)]:
        with pytest.raises(ConfigError, match="not a camera"):
            Camera(*numbers, 3.5, 2.5)
        with pytest.raises(ConfigError):
            Camera(8, 6, 7.0, 7.0, np.inf, 2.5)


def test_values_that_are_no_numbers_are_refused() -> None:
    for image, value in itertools.product(["colour", "depth"], [np.nan, np.inf, -np.inf]):
        color, depth = np.zeros((6, 8, 3), np.float32), np.ones((6, 8), np.float32)
        (color if image == "colour" else depth)[2, 3] = value
        with pytest.raises(SourceError, match=f"frame 7: {image} holds NaN or inf"):
            Frame(7, 0.0, color, depth, CAMERA)


def test_negative_depth_is_refused_and_zero_is_not() -> None:
    color, depth = np.zeros((6, 8, 3), np.float32), np.zeros((6, 8), np.float32)
    Frame(0, 0.0, color, depth.copy(), CAMERA)
    depth[1, 1] = -0.25
    with pytest.raises(SourceError, match=r"frame 0: depth is negative \(-0\.250 m\)"):
        Frame(0, 0.0, color, depth, CAMERA)


def test_sizes_that_differ_are_refused() -> None:
    for color, depth in [
        ((6, 8, 3), (8, 6)),
        ((8, 6, 3), (6, 8)),
        ((6, 8), (6, 8)),
        ((6, 8, 4), (6, 8)),
        ((3, 4, 3), (3, 4)),
    ]:
        with pytest.raises(SourceError, match="the camera is 8×6"):
            Frame(0, 0.0, np.zeros(color, np.float32), np.ones(depth, np.float32), CAMERA)


def test_a_frame_cannot_be_written_to() -> None:
    f = frame()
    with pytest.raises(ValueError):
        f.depth_m[0, 0] = 1.0
    with pytest.raises(ValueError):
        f.color[0, 0, 0] = 1.0


def test_resizing_averages_colour_over_the_area_and_picks_depth() -> None:
    f = frame()
    small = f.resized(4, 3)
    np.testing.assert_allclose(small.color, f.color.reshape(3, 2, 4, 2, 3).mean((1, 3)), atol=1e-6)
    cells = f.depth_m.reshape(3, 2, 4, 2).transpose(0, 2, 1, 3).reshape(3, 4, 4)
    assert (cells.max(-1) > 1.03 * cells.min(-1)).all(), "no four readings are on one surface"
    assert (cells == small.depth_m[..., None]).any(-1).all(), "each depth is one of the four readings"
    assert small.camera == CAMERA.resized(4, 3) and (small.index, small.timestamp_s) == (3, 0.5)
    assert f.resized(8, 6) is f


@pytest.mark.parametrize("size", [(320, 240), (240, 180), (150, 113)], ids=str)
def test_resizing_finds_a_reading_anywhere_in_the_pixels_area(size: tuple[int, int]) -> None:
    camera, drawn = Camera(640, 480, 500.0, 500.0, 319.5, 239.5), np.random.default_rng(0).random((480, 640))
    number = np.arange(480 * 640).reshape(480, 640)
    far = number % 2 + number // 640 % 2 * 2  # neighbours are on different surfaces, so no depth is interpolated
    depth = (1.0 + number / 2**20 + far).astype(np.float32)  # exact, so a reading tells which pixel it comes from
    sparse = np.where(drawn < 0.5, np.float32(0.0), depth)
    nearest, found = (
        Frame(0, 0.0, np.zeros((480, 640, 3), np.float32), d, camera).resized(*size).depth_m for d in (depth, sparse)
    )
    read = found > 0
    assert read.mean() > 0.9, "half of the readings, but four or more in each pixel's area"
    rows, columns = np.divmod(np.rint(found[read].astype(float) % 1.0 * 2**20).astype(int), 640)
    assert (sparse[rows, columns] == found[read]).all(), "no reading is averaged"
    for at, pixels, scale in zip((rows, columns), np.nonzero(read), (480 / size[1], 640 / size[0]), strict=True):
        assert np.abs(at + 0.5 - (pixels + 0.5) * scale).max() <= 0.5 * scale + 1e-9
    kept = np.isin(nearest, sparse)
    assert 0.4 < kept.mean() < 0.6
    np.testing.assert_array_equal(found[kept], nearest[kept])


@pytest.mark.parametrize("size", [(320, 240), (240, 180), (160, 120), (150, 113), (1280, 960)], ids=str)
def test_resized_depth_of_a_plane_is_on_the_plane(size: tuple[int, int]) -> None:
    camera, color = Camera(640, 480, 500.0, 500.0, 310.0, 245.0), np.zeros((480, 640, 3), np.float32)

    def plane(camera: Camera) -> NDArray[np.float32]:
        return np.asarray(1.0 / (camera.rays() @ np.array([0.2, -0.3, 0.4])), np.float32)

    small = Frame(0, 0.0, color, plane(camera), camera).resized(*size)
    inner = np.s_[2:-2, 2:-2]
    error = (small.depth_m - plane(small.camera))[inner]
    assert np.abs(error).max() < 1e-4, "the depth belongs to the centre of the pixel"


def test_resizing_mixes_no_surfaces() -> None:
    depth = np.ones((6, 8), np.float32)
    depth[:, 3:], depth[2, 6] = 2.0, 0.0
    small = Frame(0, 0.0, np.zeros((6, 8, 3), np.float32), depth, CAMERA).resized(4, 3)
    assert set(np.unique(small.depth_m)) == {1.0, 2.0}


def test_prepared_takes_out_of_range_readings_away() -> None:
    f = frame()
    out = f.prepared(0, 1.0, 4.0)
    keep = (f.depth_m >= 1.0) & (f.depth_m <= 4.0)
    assert 0 < keep.sum() < keep.size
    np.testing.assert_array_equal(out.depth_m, np.where(keep, f.depth_m, 0.0))
    np.testing.assert_array_equal(out.color, f.color)
    assert out.camera == CAMERA
    assert (f.prepared(0, 0.0, 100.0).depth_m == f.depth_m).all()


def test_prepared_keeps_the_bounds_and_the_holes() -> None:
    depth = np.tile(np.array([0.0, 0.99, 1.0, 2.0, 4.0, 4.01, 0.0, 3.0], np.float32), (6, 1))
    out = Frame(0, 0.0, np.zeros((6, 8, 3), np.float32), depth, CAMERA).prepared(0, 1.0, 4.0)
    np.testing.assert_array_equal(out.depth_m[0], np.array([0, 0, 1, 2, 4, 0, 0, 3], np.float32))


def test_prepared_sets_the_width_and_keeps_the_proportion() -> None:
    for width, height in [(4, 3), (16, 12), (6, 4)]:
        out = frame().prepared(width, 0.1, 8.0)
        assert (out.camera.width, out.camera.height) == (width, height) and out.depth_m.shape == (height, width)
        assert out.camera.fx == pytest.approx(7.0 * width / 8)


def test_cropping_drops_edges_and_moves_no_ray() -> None:
    """What is left is the inside of the resized image, seen along the same rays; readings out of range go as ever."""
    for crop_px, width in itertools.product([0, 1, 2], [0, 8, 16]):
        whole, out = frame().prepared(width, 1.0, 4.0), frame().prepared(width, 1.0, 4.0, crop_px)
        h, w = whole.depth_m.shape
        inner = np.s_[crop_px : h - crop_px, crop_px : w - crop_px]
        assert (out.camera.width, out.camera.height) == (w - 2 * crop_px, h - 2 * crop_px)
        np.testing.assert_array_equal(out.color, whole.color[inner])
        np.testing.assert_array_equal(out.depth_m, whole.depth_m[inner])
        np.testing.assert_allclose(out.camera.rays(), whole.camera.rays()[inner], atol=1e-6)
        assert out.camera == CAMERA.prepared(width, crop_px), "one rule for cameras and frames"
        assert out.color.flags.c_contiguous and out.depth_m.flags.c_contiguous, "the kernels take planes as they lie"


def test_half_size_is_cropped_after_resizing() -> None:
    small = Camera(640, 480, 517.3, 516.5, 318.6, 255.3).prepared(320, 8)
    assert (small.width, small.height) == (304, 224)
    assert (small.fx, small.fy) == pytest.approx((517.3 / 2, 516.5 / 2))
    assert (small.cx, small.cy) == pytest.approx((319.1 / 2 - 0.5 - 8, 255.8 / 2 - 0.5 - 8))


def test_a_crop_of_the_whole_image_is_refused() -> None:
    for width, crop_px in [(0, 3), (4, 2), (16, 6), (0, 100)]:
        with pytest.raises(
            ConfigError, match=rf"input\.crop_px is {crop_px}, which removes the whole image of \d+×\d+"
        ) as refused:
            frame().prepared(width, 0.1, 8.0, crop_px)
        assert "\n" not in str(refused.value)


def test_half_the_size_has_the_bytes_of_the_box_filter() -> None:
    whole = frame(Camera(30, 22, 20.0, 20.0, 14.5, 10.5))
    planes = [Image.fromarray(np.ascontiguousarray(whole.color[..., c])) for c in range(3)]
    expected = np.stack([np.asarray(plane.resize((15, 11), Image.Resampling.BOX)) for plane in planes], -1)
    assert np.array_equal(whole.resized(15, 11).color, expected)
