"""Rigid motions: the exponential against a power series, round trips where formulas are weakest, the group's laws."""

import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sigmasplat.data import se3

Array = NDArray[np.float64]
ANGLES = [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 9.9e-5, 1.01e-4, 1e-3, 0.1, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-12]
seeds = st.integers(0, 2**31)


def twist(angle: float, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])


def rigid(seed: int) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return T


def test_exp_is_the_matrix_exponential() -> None:
    for xi in map(twist, [*ANGLES, np.pi, 4.0, 7.0]):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
        np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=1e-13, err_msg=str(xi))


def test_log_undoes_exp() -> None:
    for xi in twists():
        np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


def test_half_turns_come_back() -> None:
    """At π the axis has two signs: compare the motions, not the vectors."""
    for axis in (*np.eye(3), *-np.eye(3), [0.6, 0.8, 0.0], [0.0, -0.6, 0.8], [-0.48, 0.6, -0.64]):
        xi = np.concatenate([[0.3, -0.2, 0.5], np.pi * np.array(axis)])
        found = se3.log(se3.exp(xi))
        assert np.linalg.norm(found[3:]) == pytest.approx(np.pi)
        np.testing.assert_allclose(se3.exp(found), se3.exp(xi), atol=1e-9, err_msg=str(axis))


@given(seeds)
def test_exp_undoes_log(seed: int) -> None:
    T = rigid(seed)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-8)


def twists(count: int = 5) -> Array:
    """Stack twists of every angle, |φ| ≤ π: exactly 0, tiny, on both sides of the series' bounds, nearly π."""
    return np.stack([twist(angle, seed) for angle in [*ANGLES, 0.0999, 0.1001, 2.0] for seed in range(count)])


def test_stacks_are_one_by_one() -> None:
    xi = twists()
    T = se3.exp_stack(xi)
    np.testing.assert_allclose(T, np.stack([se3.exp(x) for x in xi]), atol=1e-14)
    np.testing.assert_allclose(se3.log_stack(T), np.stack([se3.log(t) for t in T]), atol=1e-9)
    np.testing.assert_allclose(se3.exp_stack(se3.log_stack(T)), T, atol=1e-9)
    np.testing.assert_array_equal(se3.hat(xi[:, 3:])[7], se3.hat(xi[7, 3:]))
    np.testing.assert_array_equal(se3.adjoint(T)[7], se3.adjoint(T[7]))


@given(seeds)
def test_adjoint_carries_twists_across(seed: int) -> None:
    T, xi = rigid(seed), twist(0.7, seed + 1)
    np.testing.assert_allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ xi), atol=1e-13)


def test_left_jacobian_inverse_inverts_the_integral_of_the_adjoint() -> None:
    """J(ξ) = ∫₀¹ Ad(exp(sξ)) ds, read off the exponential of [[ad, 1], [0, 0]]."""
    xi = np.concatenate([twists(), [twist(4.0), twist(6.0)]])
    found = se3.left_jacobian_inverse(xi)
    for x, inverse in zip(xi, found, strict=True):
        generator = np.zeros((12, 12))
        generator[:3, :3] = generator[3:6, 3:6] = se3.hat(x[3:])
        generator[:3, 3:6], generator[:6, 6:] = se3.hat(x[:3]), np.eye(6)
        np.testing.assert_allclose(inverse @ expm(generator)[:6, 6:], np.eye(6), atol=1e-10)


def test_left_jacobian_inverse_is_the_derivative_of_log() -> None:
    h = 1e-6
    for xi in map(twist, [0.0, 1e-5, 0.1, 1.0, 3.0]):
        ends = [[se3.log(se3.exp(sign * h * axis) @ se3.exp(xi)) for axis in np.eye(6)] for sign in (1, -1)]
        slopes = (np.array(ends[0]) - np.array(ends[1])).T / (2 * h)
        np.testing.assert_allclose(se3.left_jacobian_inverse(xi[None])[0], slopes, atol=1e-8, err_msg=str(xi))


@given(seeds)
def test_inverse_of_one_and_of_a_stack(seed: int) -> None:
    stack = np.stack([rigid(seed), rigid(seed + 1)])
    np.testing.assert_allclose(se3.inverse(stack) @ stack, np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-14)
    np.testing.assert_array_equal(se3.inverse(stack)[0], se3.inverse(stack[0]))


@given(seeds)
def test_quaternions_follow_scipy_and_come_back(seed: int) -> None:
    R = rigid(seed)[:3, :3]
    q = se3.quaternion_from_rotation(R)
    x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True)
    assert q[0] >= 0
    np.testing.assert_allclose(np.abs(q @ [w, x, y, z]), 1.0, atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), R, atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-3.0 * q), R, atol=1e-14)


def test_quaternions_hold_where_w_vanishes() -> None:
    for off, axis in itertools.product((0.0, 1e-9, -1e-9, 1e-4), np.eye(3)):
        R = Rotation.from_rotvec((np.pi - off) * axis).as_matrix()
        q = se3.quaternion_from_rotation(R)
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
        np.testing.assert_allclose(se3.rotation_from_quaternion(q), R, atol=1e-14, err_msg=f"{axis} {off}")
        assert se3.rotation_angle(R) == pytest.approx(np.pi - abs(off), abs=1e-12)


def test_quaternions_turn_in_stacks() -> None:
    q = np.random.default_rng(0).normal(size=(4, 3, 4))
    many = se3.rotation_from_quaternion(q)
    assert many.shape == (4, 3, 3, 3)
    np.testing.assert_array_equal(many[2, 1], se3.rotation_from_quaternion(q[2, 1]))


def test_known_turn_and_angle() -> None:
    quarter_about_z = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(quarter_about_z[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(se3.quaternion_from_rotation(quarter_about_z[:3, :3]), [0.5**0.5, 0, 0, 0.5**0.5])
    assert se3.rotation_angle(quarter_about_z[:3, :3]) == pytest.approx(np.pi / 2)


@given(seeds)
def test_orthonormalise_finds_the_nearest_rotation(seed: int) -> None:
    T, noise = rigid(seed), 1e-3 * np.random.default_rng(seed).normal(size=(3, 3))
    bent = T.copy()
    bent[:3, :3] += noise
    mended = se3.orthonormalise(bent)
    assert se3.is_rigid(mended, 1e-12) and np.linalg.norm(mended - bent) <= np.linalg.norm(T - bent)
    np.testing.assert_array_equal(mended[:3, 3], T[:3, 3])
    np.testing.assert_allclose(se3.orthonormalise(T), T, atol=1e-14)


def test_thousands_of_products_do_not_drift() -> None:
    T, step = np.eye(4), se3.exp(np.array([1e-3, 0, 0, 1e-3, 2e-3, -1e-3]))
    for _ in range(10_000):
        T = se3.orthonormalise(T @ step)
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-14


def bad_matrices() -> list[Array]:
    mirror, scaled, shear, nan, row = (np.eye(4) for _ in range(5))
    mirror[0, 0], scaled[:3, :3], shear[0, 1], nan[0, 3], row[3, 0] = -1.0, 1.01 * np.eye(3), 0.1, np.nan, 0.1
    return [mirror, scaled, shear, nan, row, np.eye(3)]


def test_only_rigid_matrices_are_rigid() -> None:
    assert se3.is_rigid(rigid(3))
    assert not any(se3.is_rigid(T) for T in bad_matrices())
