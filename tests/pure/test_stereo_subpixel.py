"""Refinement of disparities: planes are found to a small part of a pixel, and no fraction of a pixel is preferred."""

import numpy as np
import pytest

from sigmasplat.env import opencv
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.stereo_matching import refine

SIZE = (120, 160)
ROWS, COLUMNS = np.indices(SIZE, np.float32)
PLANE_PX = 8.3 + 0.03 * (COLUMNS - 80) + 0.02 * (ROWS - 60)
INSIDE = np.s_[8:-8, 24:-24]


def pair(disparity_px, brighter=0.0, noise=0.5):
    """A left image of smooth noise, and the right image that shows it at this disparity."""
    rng, cv2 = np.random.default_rng(0), opencv()
    texture = cv2.GaussianBlur(rng.normal(0, 1, (SIZE[0], SIZE[1] + 80)).astype(np.float32), (0, 0), 1.5)
    texture = 120 + 28 * texture / texture.std()
    right = texture[:, 40:-40]
    at = COLUMNS + 40 - disparity_px.astype(np.float32)
    left = cv2.remap(texture, at, ROWS, cv2.INTER_CUBIC)
    noisy = [image + rng.normal(0, noise, SIZE) for image in (left + brighter, right)]
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy]


@pytest.mark.parametrize("brighter", [0.0, 15.0])
def test_a_slanted_plane_is_found_from_whole_pixels(brighter):
    found = refine(*pair(PLANE_PX, brighter), np.rint(PLANE_PX), np.ones(SIZE, bool))
    error = (found.disparity - PLANE_PX)[INSIDE]
    assert np.sqrt((error**2).mean()) < 0.03 and abs(error.mean()) < 0.005
    assert found.texture[INSIDE].min() > 1 and found.residual[INSIDE].max() < 3


def test_pixels_that_are_not_smooth_keep_their_disparity_and_do_not_disturb_others():
    smooth, start = np.ones(SIZE, bool), np.rint(PLANE_PX).astype(np.float32)
    smooth[50:70, 70:90] = False
    start[50:70, 70:90] = 30.0
    found = refine(*pair(PLANE_PX), start, smooth)
    assert (found.disparity[~smooth] == 30.0).all()
    beside = (found.disparity - PLANE_PX)[40:80, 60:100][smooth[40:80, 60:100]]
    assert np.abs(beside).max() < 0.15


def test_without_texture_the_disparity_stays():
    gray, start = np.full(SIZE, 90, np.uint8), np.full(SIZE, 7.25, np.float32)
    found = refine(gray, gray, start, np.ones(SIZE, bool))
    np.testing.assert_allclose(found.disparity, start, atol=1e-4)
    assert (found.texture < 1e-3).all()


def test_images_of_another_place_have_a_large_residual():
    left, right = pair(PLANE_PX)
    wrong = refine(left, right[::-1].copy(), np.rint(PLANE_PX), np.ones(SIZE, bool)).residual[INSIDE]
    right_one = refine(left, right, np.rint(PLANE_PX), np.ones(SIZE, bool)).residual[INSIDE]
    assert np.median(wrong) > 10 * np.median(right_one)


def test_depth_of_a_pair_prefers_no_fraction_of_a_pixel():
    room = open_source("synthetic:frames=61,noise=1,stereo=10,seed=3")
    depth_m, exact_m = room.frame(60).depth_m, room.exact_depth_of(60)
    read, focal_baseline = depth_m > 0, room.camera.fx * 0.1
    error_px, exact_px = focal_baseline / depth_m[read] - focal_baseline / exact_m[read], focal_baseline / exact_m[read]
    eighths = (exact_px % 1 * 8).astype(int)
    medians = [np.median(error_px[eighths == k]) for k in range(8)]
    assert np.abs(medians).max() < 0.06 and 1.4826 * np.median(np.abs(error_px)) < 0.18
