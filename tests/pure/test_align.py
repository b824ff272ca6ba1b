"""Direct alignment: it finds known motions, and its normal equations are those of the residuals it claims to have."""

import itertools
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from align_oracle import CAMERA, HUGE, MISSING, Pair, missing, oracle, pair
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit.align import Pair as Aligned, align, gray_share, normal_equations
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.plugins.sources import SyntheticRoom

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]


@cache
def room(width: int = 160, height: int = 120) -> SyntheticRoom:
    return SyntheticRoom(frames=200, width=width, height=height, exposure_change=False)


@cache
def seen(i: int, width: int = 160, height: int = 120) -> Pyramid:
    frame = room(width, height).frame(i)
    return Pyramid.of(gray_of(frame.color), frame.depth_m, frame.camera)


def motion(i: int, j: int) -> Array:
    """Return the true T_j_i."""
    T = room().truth().T_world_camera
    return se3.inverse(T[j]) @ T[i]


def assert_same_pose(found: Array, true: Array, metres: float = 2e-3, degrees: float = 0.1) -> None:
    off = se3.inverse(true) @ found
    assert np.linalg.norm(off[:3, 3]) < metres, f"{1e3 * np.linalg.norm(off[:3, 3]):.2f} mm"
    assert np.rad2deg(se3.rotation_angle(off[:3, :3])) < degrees, f"{np.rad2deg(se3.rotation_angle(off[:3, :3])):.3f}°"


def test_a_known_motion_is_found_from_standing_still() -> None:
    for (i, j), size in itertools.product([(10, 12), (101, 99)], [(160, 120), (161, 119), (95, 73)]):
        true = motion(i, j)
        assert np.linalg.norm(true[:3, 3]) > 0.03
        found = align(seen(i, *size), seen(j, *size), np.eye(4), iterations=20)
        assert_same_pose(found.T_live_reference, true, *((2e-3, 0.1) if size[0] > 100 else (4e-3, 0.15)))
        assert found.agreement > 0.9 and 0.7 < found.overlap <= 1.0
        assert se3.is_rigid(found.T_live_reference, 1e-9)


def noisy(i: int, random: np.random.Generator) -> Pyramid:
    """Return a frame with noise of 0.05 in gray, and of 0.3 % of z² in depth."""
    clean = seen(i)
    gray, depth = (clean.kernels.to_host(plane[0]) for plane in (clean.gray, clean.depth))
    gray = gray + 0.05 * random.standard_normal(gray.shape)
    depth = depth + 0.003 * depth**2 * random.standard_normal(depth.shape)
    return Pyramid.of(np.float32(gray), np.float32(depth), clean.cameras[0])


def test_noise_does_not_end_an_alignment_before_it_has_arrived() -> None:
    """Steps by H alone stop 1 mm before on average, because noise makes H too steep."""
    left_m, random = [], np.random.default_rng(0)
    for i, j in [(10, 12), (101, 99), (60, 62), (20, 21)] * 3:
        reference, live = noisy(i, random), noisy(j, random)
        rest = align(reference, live, np.eye(4), 200, update_stop=1e-9).T_live_reference
        found = align(reference, live, np.eye(4), update_stop=2e-4)
        left_m.append(np.linalg.norm((se3.inverse(rest) @ found.T_live_reference)[:3, 3]))
        assert found.steps <= 30
    assert np.mean(left_m) < 3e-4


def test_without_common_pixels_the_guess_stays() -> None:
    nothing = Pyramid.of(seen(10).gray[0], np.zeros_like(seen(10).depth[0]), seen(10).cameras[0])
    assert np.array_equal(align(nothing, seen(12), np.eye(4)).T_live_reference, np.eye(4))


def test_either_kind_of_residual_finds_the_motion() -> None:
    for weight_color in (0.0, 1.0):
        found = align(seen(10), seen(12), np.eye(4), iterations=30, weight_color=weight_color)
        assert_same_pose(found.T_live_reference, motion(10, 12), 5e-3, 0.2)


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_another_exposure_does_not_move_the_pose(gain: float) -> None:
    """The live image is darker or brighter, by more than a camera changes from frame to frame."""
    reference, same = seen(10), seen(12)
    live = replace(same, gray=[np.float32(gain) * plane for plane in same.gray])
    for weight_color in (0.5, 1.0):
        found, alike = (align(reference, image, np.eye(4), 30, weight_color) for image in (live, same))
        assert_same_pose(found.T_live_reference, alike.T_live_reference, 1e-3, 0.05)
    assert gray_share(reference, live, motion(10, 12)) > 0.8 * gray_share(reference, same, motion(10, 12))


def stained(i: int, gray: float, depth: float) -> Pyramid:
    """Return a frame with a pattern that stays where it is in the image, as reflections in gray and distortions of
    depth do; gray: 0 to 1; depth: a share."""
    clean = seen(i)
    v, u = np.indices((120, 160)) / 40.0
    pattern = np.sin(2.0 * np.pi * u) * np.sin(2.0 * np.pi * v)
    g, d = (clean.kernels.to_host(plane[0]) for plane in (clean.gray, clean.depth))
    return Pyramid.of(np.float32(g + gray * pattern), np.float32(d * (1.0 + depth * pattern)), clean.cameras[0])


def test_gray_counts_less_where_it_is_wrong_and_more_where_depth_is() -> None:
    for i, j in [(10, 14), (60, 56), (101, 105)]:
        shares = [
            gray_share(stained(i, *wrong), stained(j, *wrong), motion(i, j)) for wrong in [(0.2, 0), (0, 0), (0, 0.03)]
        ]
        assert 0.0 < shares[0] < shares[1] < shares[2] < 1.0


def test_covariance_is_positive_definite_and_grows_with_the_residual() -> None:
    covariances = [align(seen(10), seen(j), motion(10, j), 20).covariance for j in (10, 14)]
    for covariance in covariances:
        assert np.linalg.eigvalsh(covariance).min() > 0 and np.allclose(covariance, covariance.T)
    assert np.trace(covariances[1]) > 3 * np.trace(covariances[0])


def test_fewer_rows_are_those_of_a_reference_without_the_others() -> None:
    """A high image is linearised by every second row, if that is asked for; a low one always by all."""
    camera = Camera(64, 240, 60.0, 60.0, 31.5, 119.5)
    v, u = np.indices((240, 64), dtype=np.float32)
    texture = 0.5 + 0.3 * np.sin(0.31 * u + 0.1 * v) * np.cos(0.17 * v)
    image = Pyramid.of(np.float32(texture), np.float32(2.0 + 0.2 * np.sin(0.05 * (u + v))), camera)
    level, motions = Aligned(image, image, 0.5).level(0), [np.eye(4), se3.exp(np.full(6, 2e-3))]
    even = level._replace(reference_depth=np.where(v % 2 == 0, level.reference_depth, np.float32(0.0)))
    first, fewer = normal_equations(image.kernels, level, motions, whole=1)
    whole, moved = normal_equations(image.kernels, level, motions)
    np.testing.assert_array_equal(first.values, whole.values)
    np.testing.assert_allclose(fewer.values, normal_equations(image.kernels, even, motions)[1].values, rtol=1e-12)
    assert fewer.sums[1] == pytest.approx(0.5 * moved.sums[1], rel=0.05)
    low, motions = Aligned(seen(10), seen(12), 0.5).level(0), [motion(10, 12)]
    all_rows, asked = (normal_equations(image.kernels, low, motions, whole)[0].values for whole in (None, 0))
    np.testing.assert_array_equal(all_rows, asked)


def test_weight_zero_silences_a_part_of_the_reference() -> None:
    frame = room().frame(10)
    gray, depth, weight = gray_of(frame.color).copy(), frame.depth_m.copy(), np.ones((120, 160), np.float32)
    gray[:, :64], weight[:, :64] = np.roll(gray[:, :64], 9, 1), 0.0
    depth[:, :64] *= np.float32(0.97)
    silenced, heard = (Pyramid.of(gray, depth, frame.camera, w) for w in (weight, None))
    assert_same_pose(align(silenced, seen(12), np.eye(4), 20).T_live_reference, motion(10, 12), 3e-3, 0.15)
    off = se3.inverse(motion(10, 12)) @ align(heard, seen(12), np.eye(4), 20).T_live_reference
    assert np.linalg.norm(off[:3, 3]) > 6e-3, "the damage must matter, or the test proves nothing"


def test_no_motion_leaves_no_residual() -> None:
    found = align(seen(10), seen(10), np.eye(4))
    assert np.abs(found.T_live_reference - np.eye(4)).max() < 1e-5
    assert found.cost < 1e-4 and found.agreement == 1.0 and found.overlap > 0.9


@pytest.mark.parametrize("blind", ["reference", "both"])
def test_without_depth_the_guess_comes_back(blind: str) -> None:
    frame = room().frame(10)
    dark = Pyramid.of(gray_of(frame.color), np.zeros_like(frame.depth_m), frame.camera)
    guess = motion(10, 12)
    found = align(dark, dark if blind == "both" else seen(12), guess)
    np.testing.assert_allclose(found.T_live_reference, guess, atol=1e-12)
    assert found.overlap == 0.0 and found.agreement == 0.0
    np.testing.assert_array_equal(found.covariance, np.diag(np.full(6, np.inf)))  # nothing in common, nothing known


def test_distant_views_do_not_agree() -> None:
    apart, near = (align(seen(10), seen(j), np.eye(4)) for j in (110, 12))
    assert np.isfinite(apart.T_live_reference).all()
    assert apart.agreement * apart.overlap < 0.7 * near.agreement * near.overlap


def test_a_pyramids_camera_looks_through_the_middle_of_each_cell() -> None:
    frame = room(161, 119).frame(10)
    rays = [c.rays() for c in seen(10, 161, 119).cameras]
    assert [r.shape[:2] for r in rays] == [(119, 161), (59, 80), (29, 40)]
    for fine, coarse in pairwise(rays):
        h, w = coarse.shape[0] * 2, coarse.shape[1] * 2
        cells = fine[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))
        np.testing.assert_allclose(coarse, cells, atol=1e-6)
    assert np.allclose(seen(10, 161, 119).gray[1][3, 5], gray_of(frame.color)[6:8, 10:12].mean(), atol=1e-6)


def test_half_depth_never_averages_two_surfaces() -> None:
    depth = np.full((64, 64), 2.0, np.float32)
    depth[10, 10], depth[20:, 31:], depth[11, 12:14], depth[10, 14:16], depth[11, 14] = 0.0, 3.0, 0.0, 0.0, 0.0
    p = Pyramid.of(depth, depth, Camera(64, 64, 50.0, 50.0, 31.5, 31.5), levels=2)
    assert set(np.unique(p.depth[1])) == {0.0, 2.0, 3.0}
    assert p.depth[1][5, 5:8].tolist() == [2.0, 2.0, 0.0], "three readings, two, one"
    assert p.depth[1][5, 8] == 2.0 and p.depth[1][12, 15] == 0.0


# ---- one step against an oracle that differentiates its residuals numerically


def step(p: Pair, T: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """Run the kernel: H [6, 6], b [6], sums [5], grays [2]."""
    planes = (p.gray, p.depth, p.weight, p.weight_depth, p.live_gray, p.live_depth)
    images = [np.ascontiguousarray(x, np.float32) for x in planes]
    row, intrinsics = np.zeros(55), [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
    level = _core.Level(*images, intrinsics, [p.colors, p.depths, p.huber_gray, p.huber_depth, p.gate, p.gain])
    _core.align_steps(level, p.T if T is None else T, 1, row)
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = row[:21]
    return full + np.triu(full, 1).T, row[21:27], row[27:32], row[53:]


def test_normal_equations_are_those_of_the_residuals() -> None:
    for kinds, huber, holes, gain in itertools.product(
        [(1.0, 0.0), (0.0, 1.0), (0.4, 0.6)], [(HUGE, HUGE), (0.05, 0.004)], [False, True], [1.0, 1.2]
    ):
        p = replace(pair(*huber, holes), gain=gain)
        p.colors, p.depths = kinds
        (H, b, sums, grays), (want_H, want_b, want_sums, want_grays) = step(p), oracle(p)
        np.testing.assert_allclose(grays, want_grays, rtol=1e-4)
        np.testing.assert_array_equal(sums[1:], want_sums[1:])
        assert sums[1] > 800 and (not holes or sums[1] > sums[3] + 20 < sums[2])
        assert sums[0] == pytest.approx(want_sums[0], rel=1e-4)
        assert np.linalg.norm(b - want_b) < 1e-3 * np.linalg.norm(want_b)
        assert np.linalg.norm(H - want_H) < 1e-3 * np.linalg.norm(want_H)
        assert np.linalg.eigvalsh(H).min() > 0


@pytest.mark.parametrize("share", MISSING)
def test_missing_readings_leave_the_normal_equations_those_of_the_residuals(share: float) -> None:
    for kinds, huber in itertools.product([(1.0, 0.0), (0.0, 1.0), (0.4, 0.6)], [(HUGE, HUGE), (0.05, 0.004)]):
        p = missing(pair(*huber), share)
        p.colors, p.depths = kinds
        (H, b, sums, _), (want_H, want_b, want_sums, _) = step(p), oracle(p)
        np.testing.assert_array_equal(sums[1:], want_sums[1:])
        assert sums[0] == pytest.approx(want_sums[0], rel=1e-4)
        assert np.linalg.norm(b - want_b) < 1e-3 * np.linalg.norm(want_b)
        assert np.linalg.norm(H - want_H) < 1e-3 * np.linalg.norm(want_H)


def test_scattered_holes_keep_the_overlap_and_large_ones_reduce_it() -> None:
    def overlap(live_depth: Array) -> float:
        gray = gray_of(room().frame(10).color)
        live = Pyramid.of(gray, live_depth.astype(np.float32), seen(10).cameras[0])
        found = align(seen(10), live, np.eye(4), 1)
        assert found.agreement > 0.95
        return found.overlap

    depth, drawn = room().frame(10).depth_m, np.random.default_rng(0).random((120, 160))
    whole = overlap(depth)
    assert whole > 0.97
    for share in (0.5, 0.75):
        assert overlap(np.where(drawn < share, 0.0, depth)) == pytest.approx(whole, abs=0.01)
    assert overlap(np.where(np.arange(160) < 64, 0.0, depth)) == pytest.approx(0.6 * whole, abs=0.03)
    assert overlap(np.where(drawn < 0.99, 0.0, depth)) < 0.4


@pytest.mark.parametrize("share", [0.5, 0.75])
def test_a_known_motion_is_found_with_missing_readings(share: float) -> None:
    images = []
    for i in (10, 12):
        frame = room().frame(i)
        drawn = np.random.default_rng(i).random(frame.depth_m.shape)
        images.append(Pyramid.of(gray_of(frame.color), np.where(drawn < share, 0.0, frame.depth_m), frame.camera))
    found = align(images[0], images[1], np.eye(4), 20)
    assert_same_pose(found.T_live_reference, motion(10, 12), 3e-3, 0.15)
    assert found.agreement > 0.9 and found.overlap > 0.7


def test_gray_gradient_is_half_the_derivative_of_the_cost_itself() -> None:
    p = pair(huber_gray=1e3)
    p.colors, p.depths = 1.0, 0.0
    # Only pixels far from the border, so that the sums at both ends run over the same pixels.
    p.weight[:8], p.weight[-8:], p.weight[:, :8], p.weight[:, -8:] = 0.0, 0.0, 0.0, 0.0
    b, derivative = step(p)[1], []
    for e in 3e-4 * np.eye(6):
        ahead, behind = (step(p, se3.exp(sign * e) @ p.T)[2][0] for sign in (1, -1))
        derivative.append((ahead - behind) / 6e-4)
    assert np.linalg.norm(2 * b - derivative) < 2e-2 * np.linalg.norm(derivative)


def test_a_reference_behind_the_camera_contributes_nothing() -> None:
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert not any(part.any() for part in step(pair(), away))


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_a_bare_wall_decides_three_directions_and_the_guess_keeps_the_others(tilt: float) -> None:
    """Sliding along a plane without texture and turning about its normal change nothing that can be seen."""
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    depth = (-2.0 * np.cos(tilt) / (CAMERA.rays() @ normal)).astype(np.float32)
    wall = Pyramid.of(np.full(depth.shape, 0.5, np.float32), depth, CAMERA)
    along = np.cross(normal, [0.0, 1.0, 0.0])
    slide = 0.03 * along + 0.02 * np.array([0.0, 1.0, 0.0])
    off = np.concatenate([slide + 0.02 * normal, [0.004, -0.003, 0.0]])
    found = align(wall, wall, se3.exp(off), 20)
    assert found.degenerate == 3
    left = se3.log(found.T_live_reference)
    assert abs(left[:3] @ normal) < 1e-3, "the distance to the wall is found"
    assert abs(left[:3] @ along) == pytest.approx(0.03, abs=2e-3) and left[1] == pytest.approx(0.02, abs=2e-3)
    deviation = np.sqrt([axis @ found.covariance[:3, :3] @ axis for axis in (normal, along, np.array([0.0, 1.0, 0.0]))])
    assert deviation[0] < 0.01 and deviation[1:].min() > 0.3


def test_what_was_never_settled_is_the_best_seen() -> None:
    """One step at most: the finest level has seen one iterate, and that one is returned with its own cost."""
    first = align(seen(10), seen(12), motion(10, 12), 1, update_stop=0.0)
    again = align(seen(10), seen(12), first.T_live_reference, 1, update_stop=0.0)
    assert first.steps == again.steps == len(seen(10).cameras)
    many = align(seen(10), seen(12), motion(10, 12), 15, update_stop=0.0)
    assert many.cost <= min(first.cost, again.cost) * (1 + 1e-6)


def test_a_plateau_ends_a_level() -> None:
    whole = align(seen(10), seen(12), np.eye(4), 15, update_stop=0.0)
    early = align(seen(10), seen(12), np.eye(4), 15, update_stop=0.0, plateau_stop=1e-3)
    assert whole.steps == 15 * len(seen(10).cameras) and early.steps < 0.6 * whole.steps
    assert_same_pose(early.T_live_reference, whole.T_live_reference, 1e-3, 0.05)
