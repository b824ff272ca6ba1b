"""Hold what descent moves, in each parametrisation, against its definition and finite differences, in double."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from paper_settings import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.fit.descent import AxisAngle, QuaternionMotion, parametrisation

Array = NDArray[np.float64]
AXES = np.array([[0.6, -0.48, 0.64], [1.0, 0.0, 0.0], [0.0, 0.6, -0.8]])
ANGLES = [0.0, 1e-9, 1e-5, 1e-3, 0.4, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi, np.pi + 0.2, 5.0]
KINDS: list[type[AxisAngle] | type[QuaternionMotion]] = [QuaternionMotion, AxisAngle]


def guess(rotation: Array | None = None) -> Array:
    """Make a T_camera_world far from the world's origin."""
    return se3.exp(np.concatenate([[0.7, -1.9, 0.4], [0.3, -0.8, 0.5] if rotation is None else rotation]))


def value(T: Array) -> float:
    """Weigh what a few points become in the camera: a smooth function of the pose alone."""
    points = np.array([[0.2, 1.1, 2.5, 1.0], [-1.3, 0.4, 1.7, 1.0], [0.8, -0.9, 3.1, 1.0], [2.0, 1.5, -0.6, 1.0]])
    seen = (T @ points.T)[:3]
    return float(np.sin(seen * np.array([[0.7], [1.3], [0.4]]) + np.arange(4)).sum())


def differences(f: Callable[[Array], float], at: Array, step: float = 1e-3) -> Array:
    """Differentiate a function of a vector, central and of fourth order."""
    slopes = []
    for k in range(len(at)):
        e = np.zeros(len(at))
        e[k] = step
        slopes.append((8 * (f(at + e) - f(at - e)) - (f(at + 2 * e) - f(at - 2 * e))) / (12 * step))
    return np.array(slopes)


def assert_gradient(way: AxisAngle | QuaternionMotion, numbers: Array) -> None:
    T = way.pose(numbers)
    twist = differences(lambda xi: value(se3.exp(xi) @ T), np.zeros(6))
    expected = differences(lambda x: value(way.pose(x)), numbers)
    assert np.abs(expected).max() > 0.1, "the test needs a slope"
    atol = 1e-9 * max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(way.gradient(numbers, twist), expected, atol=atol, err_msg=f"at {numbers}")


def test_the_gradient_by_the_axis_angle_is_that_of_the_pose() -> None:
    for axis, angle in itertools.product(AXES, ANGLES):
        assert_gradient(AxisAngle(np.eye(4)), np.concatenate([angle * axis, [0.5, -1.2, 0.3]]))


def test_the_gradient_by_the_quaternion_is_that_of_the_pose() -> None:
    for norm, angle in itertools.product((1.0, 0.7, 1.6), ANGLES):
        q = norm * np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * AXES[0]])
        assert_gradient(QuaternionMotion(guess()), np.concatenate([q, [0.5, -1.2, 0.3]]))


@pytest.mark.parametrize("kind", KINDS)
def test_descent_starts_from_the_guess(kind: type[AxisAngle] | type[QuaternionMotion]) -> None:
    for angle in ANGLES[:9]:
        way = kind(guess(angle * AXES[0]))
        np.testing.assert_allclose(way.pose(way.start), way.guess, atol=1e-12)
        assert len(way.start) == way.rotations + 3
        assert np.linalg.norm(way.start[: way.rotations]) <= np.pi + 1e-12
        assert_gradient(way, way.start)


def test_axis_angle_is_of_the_camera_in_the_world() -> None:
    """ω turns the camera-to-world rotation, t_wc is where the camera stands; each leaves the other alone."""
    way = AxisAngle(guess())
    T_world_camera = se3.inverse(way.guess)
    np.testing.assert_allclose(way.start[:3], se3.log_rotation(T_world_camera[:3, :3]), atol=1e-15)
    np.testing.assert_allclose(way.start[3:], T_world_camera[:3, 3], atol=1e-15)
    turned = se3.inverse(way.pose(way.start + np.array([0.1, -0.2, 0.3, 0, 0, 0])))
    np.testing.assert_allclose(turned[:3, 3], T_world_camera[:3, 3], atol=1e-12)
    moved = se3.inverse(way.pose(way.start + np.array([0, 0, 0, 1.0, 2.0, 3.0])))
    np.testing.assert_allclose(moved[:3, :3], T_world_camera[:3, :3], atol=1e-12)


def test_the_settings_choose() -> None:
    assert isinstance(parametrisation(TrackingConfig(), guess()), QuaternionMotion)
    assert isinstance(parametrisation(TrackingConfig(parametrisation="axis-angle"), guess()), AxisAngle)
