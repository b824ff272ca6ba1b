"""Comparing two RGB-D images at a motion: what a right pose, a wrong one, and something in front look like."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.fit.compare import NOTHING, Comparison, compare, noise_scale
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.plugins.sources import SyntheticRoom

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Image = NDArray[np.float32]
FIRST, SECOND = 40, 44


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    return SyntheticRoom(frames=200, width=160, height=120, exposure_change=False)


@pytest.fixture(scope="module")
def views(room: SyntheticRoom) -> tuple[Frame, Frame, NDArray[np.float64]]:
    """Return two frames and the true motion T_live_reference."""
    T = room.truth().T_world_camera
    return room.frame(FIRST), room.frame(SECOND), se3.inverse(T[SECOND]) @ T[FIRST]


def pyramid(frame: Frame, gray: Image | None = None, depth_m: Image | None = None) -> Pyramid:
    return Pyramid.of(
        gray_of(frame.color) if gray is None else gray, frame.depth_m if depth_m is None else depth_m, frame.camera
    )


def at_truth(views: tuple[Frame, Frame, NDArray[np.float64]]) -> Comparison:
    reference, live, motion = views
    return compare(pyramid(reference), pyramid(live), motion)


def test_at_the_true_pose_the_surfaces_are_the_same(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    found = at_truth(views)
    assert found.common > 0.8 and found.close > 0.97 and found.residual < 0.5 and found.correlation > 0.9
    assert found.close + found.front + found.behind == pytest.approx(1.0)


def test_the_share_in_common_is_that_of_the_overlap(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    """Of a camera that is turned by a quarter of its view, three quarters of the image remain."""
    reference = views[0]
    c = reference.camera
    turned = se3.exp(np.array([0, 0, 0, 0, np.arctan(c.width / 2 / c.fx) / 2, 0]))
    wall = np.full_like(reference.depth_m, 2.0)
    found = compare(pyramid(reference, depth_m=wall), pyramid(reference, depth_m=wall), turned)
    assert found.common == pytest.approx(0.75, abs=0.08)


def test_a_shifted_pose_sees_surfaces_behind_and_in_front(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    reference, live, motion = views
    pyramids, right = (pyramid(reference), pyramid(live)), at_truth(views)
    for axis in range(3):
        for shift_m in (-0.1, 0.1):
            moved = motion.copy()
            moved[axis, 3] += shift_m
            found = compare(*pyramids, moved)
            assert found.residual > right.residual and found.close < right.close
            assert found.correlation < right.correlation - 0.05 and found.front + found.behind > 0.05
    nearer, farther = motion.copy(), motion.copy()
    nearer[2, 3] -= 0.3
    farther[2, 3] += 0.3
    assert compare(*pyramids, nearer).behind > 0.6 and compare(*pyramids, farther).front > 0.6


def test_an_object_in_front_is_not_held_against_the_pose(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    reference, live, motion = views
    gray, depth_m, right = gray_of(live.color).copy(), live.depth_m.copy(), at_truth(views)
    covered = np.s_[:, : live.camera.width // 2]
    depth_m[covered] = 0.4
    gray[covered] = np.random.default_rng(0).uniform(0, 1, gray[covered].shape)
    found = compare(pyramid(reference), pyramid(live, gray, depth_m), motion)
    assert found.front == pytest.approx(0.5, abs=0.15) and found.behind < 0.02
    assert found.close == pytest.approx(1.0 - found.front, abs=0.03)
    assert found.residual == pytest.approx(right.residual, abs=0.2)
    assert found.correlation == pytest.approx(right.correlation, abs=0.1)


def test_a_removed_object_contradicts_the_pose(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    """The map is seen through: this is what a wrong pose looks like, so it must not count as something new."""
    reference, live, motion = views
    depth_m = reference.depth_m.copy()
    depth_m[:, : reference.camera.width // 2] = 0.4
    found = compare(pyramid(reference, depth_m=depth_m), pyramid(live), motion)
    assert found.behind > 0.2 and found.front < 0.05


def test_exposure_does_not_change_the_correlation(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    reference, live, motion = views
    darker = (0.4 * gray_of(live.color) + 0.1).astype(np.float32)
    found = compare(pyramid(reference), pyramid(live, darker), motion)
    assert found.correlation == pytest.approx(at_truth(views).correlation, abs=1e-4)


def test_a_flat_image_has_no_correlation(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    reference, live, motion = views
    flat = np.full_like(live.depth_m, 0.5)
    assert np.isnan(compare(pyramid(reference), pyramid(live, flat), motion).correlation)
    assert np.isnan(compare(pyramid(reference, flat), pyramid(live), motion).correlation)


def test_other_texture_on_the_same_surface_does_not_correlate() -> None:
    """A wall fits itself at every place; its texture tells where the camera is."""
    random = np.random.default_rng(1)
    camera = SyntheticRoom(frames=1, width=160, height=120).camera
    wall = np.full((120, 160), 2.0, np.float32)
    one, other = (np.kron(random.uniform(0, 1, (12, 16)), np.ones((10, 10))).astype(np.float32) for _ in range(2))
    a, b = Pyramid.of(one, wall, camera), Pyramid.of(other, wall, camera)
    same, different = compare(a, a, np.eye(4)), compare(a, b, np.eye(4))
    assert same.correlation > 0.99 and abs(different.correlation) < 0.4
    assert different.close == same.close == 1.0


def noisy(frame: Frame, sigmas: float, seed: int) -> Image:
    """Return depth with noise in units of the assumed standard deviation of a reading."""
    z = frame.depth_m
    noise = np.random.default_rng(seed).normal(0.0, sigmas, z.shape) * (0.003 * z**2 + 0.002)
    return np.where(z > 0, z + noise, 0.0).astype(np.float32)


def test_noisier_depth_raises_the_unit_of_the_residual(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    """The noise of the sensor is measured: with four times as much of it, a right pose still looks right."""
    reference, live, motion = views
    exact, usual, much = (noise_scale(noisy(live, sigmas, 1)) for sigmas in (0.0, 1.0, 4.0))
    assert exact == 1.0 and usual == pytest.approx(1.0, abs=0.15) and much == pytest.approx(4.0, rel=0.15)
    found = compare(
        pyramid(reference, depth_m=noisy(reference, 4.0, 2)), pyramid(live, depth_m=noisy(live, 4.0, 1)), motion
    )
    assert found.residual < 1.5 and found.close > 0.9


def test_a_slanted_plane_is_not_noise(room: SyntheticRoom) -> None:
    slanted = np.tile(np.linspace(1.0, 3.0, 160, dtype=np.float32), (120, 1))
    assert noise_scale(slanted) == 1.0


def test_missing_readings_do_not_look_like_another_surface(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    reference, live, motion = views
    random = np.random.default_rng(0)
    depths = (np.where(random.uniform(size=f.depth_m.shape) < 0.5, f.depth_m, 0) for f in (reference, live))
    found = compare(*(pyramid(f, depth_m=d) for f, d in zip((reference, live), depths, strict=True)), motion)
    right = at_truth(views)
    assert found.close > right.close - 0.02 and found.common > 0.7 * right.common
    assert found.correlation > right.correlation - 0.05


@pytest.mark.parametrize("empty", ["reference", "live", "both"])
def test_without_readings_there_is_nothing(views: tuple[Frame, Frame, NDArray[np.float64]], empty: str) -> None:
    reference, live, motion = views
    none = np.zeros_like(live.depth_m)
    one = pyramid(reference, depth_m=none if empty != "live" else None)
    other = pyramid(live, depth_m=none if empty != "reference" else None)
    assert compare(one, other, motion) is NOTHING
    assert NOTHING.common == NOTHING.close == 0.0


def test_a_camera_that_looks_away_has_nothing_in_common(views: tuple[Frame, Frame, NDArray[np.float64]]) -> None:
    away = se3.exp(np.array([0, 0, 0, 0, np.pi, 0])) @ views[2]
    assert compare(pyramid(views[0]), pyramid(views[1]), away) is NOTHING
