"""Hold the kernels that prepare and compare images to their definitions in numpy, on every instruction set."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from image_definitions import (
    compare_in_numpy,
    free_places_in_numpy,
    halved_color_in_numpy,
    halved_depth_in_numpy,
    halved_in_numpy,
    noise_scale_in_numpy,
    read_before_in_numpy,
    resized_depth_in_numpy,
    target_in_torch,
)
from sigmasplat.data import images, se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import Readout, SensorTimes, depth_of_color, read_at_once
from sigmasplat.fit.compare import NOTHING, compare, noise_scale
from sigmasplat.fit.cpu import halved, halved_depth
from sigmasplat.fit.pyramid import HIDDEN_M, Pyramid
from sigmasplat.fit.target import LUMA, Target, gray_of
from sigmasplat.tracking.moving.free_space import free_places

Image = NDArray[np.float32]
HEIGHT, WIDTH = 90, 122
CAMERA = Camera(WIDTH, HEIGHT, 110.0, 108.0, 61.3, 44.2)


def color(height: int = HEIGHT, width: int = WIDTH) -> Image:
    """Return noise that leaves [0, 1] a little, as resampled colour does."""
    return np.random.default_rng(1).uniform(-0.1, 1.1, (height, width, 3)).astype(np.float32)


def depth(noise_m: float = 0.004) -> Image:
    """Return a curved surface with a step, a hole and scattered holes, metres."""
    random = np.random.default_rng(2)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    z = 2.0 + 0.4 * np.sin(v / 17) + 0.3 * np.cos(u / 23) + random.normal(0, noise_m, (HEIGHT, WIDTH))
    z[40:, 70:] *= 0.6
    z[10:25, 30:50] = 0.0
    z[random.random(z.shape) < 0.1] = 0.0
    return z.astype(np.float32)


@pytest.mark.parametrize("size", [(61, 45), (40, 45), (61, 30), (37, 29), (122, 180), (244, 180), (121, 89), (1, 1)])
def test_resized_depth_has_the_bytes_of_its_definition(isa: str, size: tuple[int, int]) -> None:
    expected = resized_depth_in_numpy(depth(), *size)
    assert np.array_equal(images.resized_depth(depth(), *size), expected), isa
    kept = (expected >= 1.5) & (expected <= 2.3)
    assert np.array_equal(images.resized_depth(depth(), *size, 1.5, 2.3), np.where(kept, expected, 0))


@pytest.mark.parametrize("size", [(90, 122), (2, 2), (2, 38), (64, 64)])
def test_halved_colour_has_the_bytes_of_its_definition(isa: str, size: tuple[int, int]) -> None:
    image = color(*size)
    assert np.array_equal(
        images.resized_color(image, image.shape[1] // 2, image.shape[0] // 2), halved_color_in_numpy(image)
    ), isa


@pytest.mark.parametrize("size", [(90, 122), (33, 67), (2, 2), (40, 64)])
def test_pyramids_have_the_bytes_of_their_definition(isa: str, size: tuple[int, int]) -> None:
    image, z = gray_of(color(*size)), depth()[: size[0], : size[1]].copy()
    assert np.array_equal(halved(image), halved_in_numpy(image)), isa
    assert np.array_equal(halved_depth(z), halved_depth_in_numpy(z)), isa


def test_gray_is_the_luma(isa: str) -> None:
    np.testing.assert_allclose(gray_of(color()), color() @ LUMA, atol=1e-6, err_msg=isa)


def test_a_target_has_the_image_and_zeros_beyond_it(isa: str) -> None:
    frame, size = Frame(0, 0.0, color(), depth(), CAMERA), (96, 128)
    found, expected = Target.of(frame, size), target_in_torch(frame, size)
    assert torch.equal(found.color, expected.color) and torch.equal(found.depth, expected.depth), isa
    assert found.valid_pixels == expected.valid_pixels


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.1])
def test_the_noise_of_depth_is_that_of_its_definition(isa: str, noise_m: float) -> None:
    assert noise_scale(depth(noise_m)) == noise_scale_in_numpy(depth(noise_m)), isa


@pytest.mark.parametrize("shift_m", [0.0, 0.03, 0.4])
def test_a_comparison_is_that_of_its_definition(isa: str, shift_m: float) -> None:
    hidden = depth(0.02)
    hidden[50:70, 20:60] = HIDDEN_M
    reference, live = (Pyramid.of(gray_of(color()), z, CAMERA) for z in (depth(), hidden))
    T = se3.exp(np.array([shift_m, 0.01, -shift_m, 0.01, -0.02, 0.03]))
    found, expected = compare(reference, live, T), compare_in_numpy(reference, live, T)
    assert found.points == expected.points > 100, isa
    for name in ("common", "close", "front", "behind", "residual", "correlation", "covered"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9, abs=1e-12, nan_ok=True), name


def test_images_without_common_pixels_are_not_compared(isa: str) -> None:
    image, away = Pyramid.of(gray_of(color()), depth(), CAMERA), se3.exp(np.array([0, 0, -5.0, 0, 0, 0]))
    assert compare(image, image, away) == NOTHING == compare_in_numpy(image, image, away), isa
    flat = Pyramid.of(np.full((HEIGHT, WIDTH), 0.5, np.float32), depth(), CAMERA)
    assert np.isnan(compare(image, flat, np.eye(4)).correlation)


@pytest.mark.parametrize("further_px", [0, 1, 7, 200])
@pytest.mark.parametrize("shift_m", [0.0, -0.1, 0.5])
def test_free_places_are_those_of_their_definition(isa: str, further_px: int, shift_m: float) -> None:
    """Points on and in front of the surface, behind the camera and beside the image; every 17 floats, as in a map."""
    random = np.random.default_rng(3)
    rows = np.zeros((20_000, 17), np.float32)
    rows[:, :3] = random.uniform((-2.5, -2.0, -0.5), (2.5, 2.0, 3.0), (20_000, 3))
    T = se3.exp(np.array([shift_m, 0.01, -shift_m, 0.01, -0.02, 0.03]))
    for points in (rows[:, :3].T, np.ascontiguousarray(rows[:, :3].T), rows[:0, :3].T):
        found = free_places(points, T, depth(), CAMERA, 0.05, further_px)
        assert np.array_equal(found, free_places_in_numpy(points, T, depth(), CAMERA, 0.05, further_px)), isa
    if further_px < 200:  # in a window as large as the image, some reading is near
        assert 100 < free_places(rows[:, :3].T, T, depth(), CAMERA, 0.05, further_px).sum() < 3000


@pytest.mark.parametrize("fast", [0.3, 2.0])
def test_depth_at_another_time_is_that_of_its_definition(isa: str, fast: float) -> None:
    """Depth to 10 µm, but for a few pixels that are next to another surface in one of both. Colour is a ramp: it says
    from which column it was taken."""
    readout = Readout(
        fast * np.array([0.5, -0.4, 0.6, 0.7, -1.0, 0.4]), 0.004, SensorTimes(0.016, 0.03, 0.025, std_s=(1e-3,) * 3)
    )
    ramp = np.repeat(np.tile(np.linspace(0, 1, WIDTH, dtype=np.float32), (HEIGHT, 1))[..., None], 3, 2)
    frame = read_at_once(Frame(0, 0.0, ramp, depth(), CAMERA), readout)
    (before, at), (of_color, _) = (read_before_in_numpy(depth(), CAMERA, readout, which) for which in (False, True))
    for found, expected in ((frame.depth_m, before), (depth_of_color(CAMERA, depth(), readout), of_color)):
        other = np.abs(found - expected) > 1e-5 + 1e-4 * fast**3
        assert found.dtype == np.float32 and other.mean() < 0.01 and np.abs(found - depth()).mean() > 0.01, isa
    inner = (at[0] > 1) & (at[0] < WIDTH - 2) & (np.abs(frame.depth_m - before) < 1e-3)
    np.testing.assert_allclose(frame.color[..., 0][inner], at[0][inner] / (WIDTH - 1), atol=5e-4)


def test_free_places_need_points_and_an_image() -> None:
    with pytest.raises(ValueError, match=r"points \[3, n\]"):
        free_places(np.zeros((2, 5), np.float32), np.eye(4), depth(), CAMERA)
    with pytest.raises(ValueError, match=r"image is \[H, W\]"):
        free_places(np.zeros((3, 5), np.float32), np.eye(4), depth()[0], CAMERA)
