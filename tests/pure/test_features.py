"""Sparse features: points, matches, landmarks, and poses from them, on images with exact geometry."""

import subprocess
import sys
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.fit.target import gray_of
from sigmasplat.plugins.sources.synthetic import SyntheticRoom
from sigmasplat.tracking import features as features_module
from sigmasplat.tracking.features import (
    Extractor,
    Features,
    Landmarks,
    depth_readings,
    landmarks_of,
    pose_from_landmarks,
)

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def gray_bytes(frame: Frame) -> NDArray[np.uint8]:
    return np.rint(gray_of(frame.color) * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    return SyntheticRoom(frames=120, width=640, height=480)


@pytest.fixture(scope="module")
def views(room: SyntheticRoom) -> tuple[Frame, Frame, NDArray[np.float64]]:
    """Return two frames about 20° apart, and the true motion T_live_reference."""
    T = room.truth().T_world_camera
    motion = se3.inverse(T[47]) @ T[40]
    assert 18 < np.degrees(se3.rotation_angle(motion[:3, :3])) < 25
    return room.frame(40), room.frame(47), motion


@pytest.fixture(scope="module")
def texture() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).uniform(0, 1, (300, 400)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def points_and_pairs(count: int, outliers: int, seed: int = 0) -> tuple[Landmarks, Features, Any, Any]:
    """Return exact landmarks and their image in a moved camera; the first `outliers` matches are false."""
    random = np.random.default_rng(seed)
    pixels = random.uniform([5, 5], [CAMERA.width - 5, CAMERA.height - 5], (count, 2)).astype(np.float32)
    z = random.uniform(1.0, 3.0, count)
    rays = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points = np.c_[rays, np.ones(count)] * z[:, None]
    motion = se3.exp(np.array([0.1, -0.05, 0.08, 0.02, 0.1, -0.05]))
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    seen = moved[:, :2] / moved[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    seen[:outliers] = random.uniform([0, 0], [CAMERA.width, CAMERA.height], (outliers, 2))
    nothing = np.zeros((count, 1), np.float32)
    landmarks = Landmarks(Features(pixels, nothing, CAMERA), points)
    return (
        landmarks,
        Features(seen.astype(np.float32), nothing, CAMERA),
        np.tile(np.arange(count), (2, 1)).T,
        motion,
    )


def distance(T: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float]:
    """Return metres and degrees between two poses."""
    error = T @ se3.inverse(other)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.rotation_angle(error[:3, :3])))


@pytest.mark.parametrize("depth_width", [640, 320])
def test_pose_between_views_20_degrees_apart(depth_width: int, views: Any) -> None:
    reference, live, motion = views
    features = Extractor()
    small = reference.resized(depth_width, depth_width * 3 // 4)
    landmarks = landmarks_of(features.find(gray_bytes(reference), reference.camera), small.depth_m, small.camera)
    seen = features.find(gray_bytes(live), live.camera)
    found = pose_from_landmarks(landmarks, seen, features.match(landmarks.features, seen), 0)
    metres, degrees = distance(found.T_live_reference, motion)
    assert metres < 0.01 and degrees < 0.3
    assert found.inliers == found.supporting.sum() > 50


def test_same_bits_for_any_number_of_threads(views: Any) -> None:
    reference, live, _ = views

    def once() -> tuple[bytes, ...]:
        features = Extractor()
        first = features.find(gray_bytes(reference), reference.camera)
        landmarks, seen = (
            landmarks_of(first, reference.depth_m, reference.camera),
            features.find(gray_bytes(live), live.camera),
        )
        pairs = features.match(landmarks.features, seen)
        pose = pose_from_landmarks(landmarks, seen, pairs, 3)
        arrays = (first.points, first.descriptors, pairs, pose.T_live_reference)
        return tuple(np.ascontiguousarray(each).tobytes() for each in arrays)

    before, results = cv2.getNumThreads(), []
    try:
        for threads in (1, 2, 2):
            cv2.setNumThreads(threads)
            results.append(once())
    finally:
        cv2.setNumThreads(before)
    assert results[0] == results[1] == results[2]


def test_points_move_with_the_image(texture: NDArray[np.uint8]) -> None:
    features = Extractor()
    first = features.find(np.ascontiguousarray(texture[20:260, 20:340]), CAMERA)
    moved = features.find(np.ascontiguousarray(texture[17:257, 19:339]), CAMERA)
    pairs = features.match(first, moved)
    shift = moved.points[pairs[:, 1]] - first.points[pairs[:, 0]]
    assert len(pairs) > 100
    assert np.abs(np.median(shift, 0) - [1, 3]).max() < 0.05


def test_pixel_centres_are_at_integers(texture: NDArray[np.uint8]) -> None:
    """In the mirrored image, pixel u of W pixels becomes W − 1 − u."""
    image = texture[:240, :320]
    features = Extractor()
    plain, mirrored = (features.find(np.ascontiguousarray(each), CAMERA) for each in (image, image[:, ::-1]))
    back = np.stack([319 - mirrored.points[:, 0], mirrored.points[:, 1]], 1)
    gap = plain.points[:, None] - back[None]
    nearest = gap[np.arange(len(plain)), np.abs(gap).sum(2).argmin(1)]
    nearest = nearest[np.abs(nearest).max(1) < 1]
    assert len(nearest) > 100 and np.abs(np.median(nearest[:, 0])) < 0.1


def test_features_are_sorted_and_limited(texture: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.ascontiguousarray(texture[:240, :320])
    monkeypatch.setattr(features_module, "COUNT", 200)
    many = Extractor().find(image, CAMERA)
    monkeypatch.setattr(features_module, "COUNT", 50)
    few = Extractor().find(image, CAMERA)
    assert len(few) <= 50 < len(many) <= 200
    assert many.points.shape == (len(many), 2) and many.points.dtype == np.float32
    assert np.allclose(np.linalg.norm(many.descriptors, axis=1), 1.0, atol=0.02)


def test_an_empty_image_has_no_features() -> None:
    features = Extractor()
    none = features.find(np.zeros((240, 320), np.uint8), CAMERA)
    assert len(none) == 0 and features.match(none, none).shape == (0, 2)
    landmarks = landmarks_of(none, np.ones((240, 320), np.float32), CAMERA)
    assert len(landmarks) == 0
    assert pose_from_landmarks(landmarks, none, np.zeros((0, 2), np.intp), 0) is None


def test_wide_images_are_reduced(views: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    reference = views[0]
    monkeypatch.setattr(features_module, "FEATURE_WIDTH", 320)
    found = Extractor().find(gray_bytes(reference), reference.camera)
    assert found.camera == reference.camera.resized(320, 240)
    assert found.points[:, 0].max() < 320


def test_depth_is_taken_at_the_same_place_for_any_size() -> None:
    wide, small = Camera(640, 480, 600.0, 600.0, 319.5, 239.5), Camera(318, 238, 300.0, 300.0, 158.5, 118.5)
    assert small == wide.prepared(320, 1)
    depth = np.fromfunction(lambda v, u: 2.0 + 1e-4 * u + 1e-3 * v, (238, 318)).astype(np.float32)
    # The centre of pixel (c, r) of the small image is at (2 (c + 1) + ½, 2 (r + 1) + ½) of the wide one.
    pixels = np.array([[10, 20], [200, 100], [317, 237]])
    points = (2 * (pixels + 1) + 0.5).astype(np.float32)
    features = Features(points, np.zeros((3, 1), np.float32), wide)
    landmarks = landmarks_of(features, depth, small)
    expected = depth[pixels[:, 1], pixels[:, 0]]
    assert np.array_equal(landmarks.points_m[:, 2], expected.astype(np.float64))
    rays = small.rays()[pixels[:, 1], pixels[:, 0]]
    assert np.allclose(landmarks.points_m, rays * expected[:, None], atol=1e-5)


def test_landmarks_need_a_reading_away_from_steps() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, 160:] = 3.0  # a step
    depth[100, 50] = 0.0  # a hole
    points = np.array([[50, 100], [49, 100], [80, 100], [159, 100], [160, 100], [200, 100], [330, 100]], np.float32)
    features = Features(points, np.arange(7, dtype=np.float32)[:, None], CAMERA)
    landmarks = landmarks_of(features, depth, CAMERA)
    assert landmarks.features.descriptors[:, 0].tolist() == [1, 2, 5]
    assert depth_readings(features, depth, CAMERA).tolist() == [0, 2, 2, 0, 0, 3, 0]


def test_false_matches_do_not_move_the_pose() -> None:
    landmarks, features, pairs, motion = points_and_pairs(100, 40)
    found = pose_from_landmarks(landmarks, features, pairs, 0)
    metres, degrees = distance(found.T_live_reference, motion)
    assert metres < 1e-3 and degrees < 0.03
    assert found.supporting[40:].all() and found.supporting[:40].sum() < 3


def test_few_matches_give_no_pose() -> None:
    landmarks, features, pairs, _ = points_and_pairs(100, 0)
    assert pose_from_landmarks(landmarks, features, pairs[:7], 0) is None
    assert pose_from_landmarks(landmarks, features, pairs[:12], 0) is not None
    landmarks, features, pairs, _ = points_and_pairs(30, 30)
    assert pose_from_landmarks(landmarks, features, pairs, 0) is None


def test_opencv_is_imported_when_it_is_needed() -> None:
    code = (
        "import sys, sigmasplat.system.slam, sigmasplat.tracking.features, sigmasplat.cli; print('cv2' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"
