"""A gyroscope and an accelerometer that measure while images arrive: rotations, bias, gaps, late samples."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmasplat.data import se3
from sigmasplat.data.imu import (
    KEPT_S,
    MOST_LATE_S,
    Gyroscope,
    RecentSamples,
    RunningAccelerometer,
    RunningGyroscope,
    still_bias,
)

VELOCITY = np.array([0.2, 1.5, -0.4])
"""rad/s"""


def angle(R_a: np.ndarray | None, R_b: np.ndarray | None, turned: np.ndarray) -> float:
    """Return how far the rotation from a to b is from the expected rotation vector, rad."""
    assert R_a is not None and R_b is not None
    return se3.rotation_angle(Rotation.from_rotvec(turned).as_matrix().T @ R_a.T @ R_b)


def constant(first_s: float, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    times_s = np.arange(first_s, end_s, 0.005)
    return times_s, np.tile(VELOCITY, (len(times_s), 1))


def test_rotations_equal_those_of_the_whole_recording() -> None:
    """However the samples are divided over the images, also with images that are left out."""
    rng = np.random.default_rng(3)
    times_s = np.arange(0.0, 4.0, 0.005) + rng.uniform(-0.001, 0.001, 800)
    rates = np.stack([np.sin(3 * times_s + i) * 2.0 for i in range(3)], 1)
    whole, running, done = Gyroscope(times_s, rates), RunningGyroscope(), 0
    pairs = []
    for image_s in np.arange(0.1, 3.9, 1 / 30):
        end = int(np.searchsorted(times_s, image_s + rng.uniform(0.006, 0.05)))  # one sample is later than the image
        running.add(times_s[done:end], rates[done:end])
        done = max(done, end)
        if rng.random() < 0.7:
            pairs.append((running.R_inertial_camera(image_s), whole.R_inertial_camera(image_s)))
    assert len(pairs) > 50
    for (R_a, W_a), (R_b, W_b) in itertools.pairwise(pairs):
        assert R_a is not None and R_b is not None and W_a is not None and W_b is not None
        np.testing.assert_allclose(R_a.T @ R_b, W_a.T @ W_b, atol=1e-9)


def test_samples_that_are_late_are_replaced_by_the_newest_velocity() -> None:
    running = RunningGyroscope()
    running.add(*constant(0.0, 0.101))
    R_a, R_b = running.R_inertial_camera(0.05), running.R_inertial_camera(0.1 + 0.8 * MOST_LATE_S)
    assert angle(R_a, R_b, VELOCITY * (0.05 + 0.8 * MOST_LATE_S)) < 1e-9
    assert running.R_inertial_camera(0.1 + 1.2 * MOST_LATE_S) is None
    running.add(*constant(0.105, 0.3))
    assert angle(R_b, running.R_inertial_camera(0.2), VELOCITY * (0.1 - 0.8 * MOST_LATE_S)) < 1e-9


def test_late_samples_correct_the_next_rotation() -> None:
    """The camera stops after the newest sample; the rotation of the next image starts at the image before it."""
    running = RunningGyroscope()
    running.add(*constant(0.0, 0.101))
    running.R_inertial_camera(0.1)
    R_a = running.R_inertial_camera(0.12)
    times_s = np.arange(0.105, 0.3, 0.005)
    running.add(times_s, np.zeros((len(times_s), 3)))
    assert angle(R_a, running.R_inertial_camera(0.2), np.zeros(3)) < 1e-9


def test_the_bias_is_measured_before_the_turn_and_removed() -> None:
    rng, times_s, bias = np.random.default_rng(1), np.arange(0, 6, 0.005), np.array([0.02, -0.01, 0.015])
    rates = np.where(times_s > 3, 1.0, 0.0)[:, None] * VELOCITY + rng.normal(0, 0.003, (len(times_s), 3)) + bias
    running, R = RunningGyroscope(), {}
    for i in range(179):
        image_s = (i + 1) / 30
        chosen = (times_s > image_s - 1 / 30) & (times_s <= image_s)
        running.add(times_s[chosen], rates[chosen])
        R[i] = running.R_inertial_camera(image_s)
    with_bias = angle(R[0], R[20], np.zeros(3))
    assert with_bias > 0.5 * np.linalg.norm(bias) * 20 / 30, "not known yet in the first second"
    assert angle(R[35], R[80], np.zeros(3)) < 0.004 < np.linalg.norm(bias) * 45 / 30
    assert angle(R[95], R[170], VELOCITY * 75 / 30) < 0.004
    still = times_s < 3
    np.testing.assert_allclose(running._bias.rad_s, still_bias(times_s[still], rates[still]), atol=5e-4)


def test_a_steady_turn_is_no_bias() -> None:
    running = RunningGyroscope()
    running.add(*constant(0.0, 2.5))
    assert angle(running.R_inertial_camera(0.1), running.R_inertial_camera(2.4), VELOCITY * 2.3) < 1e-9


def test_the_rotation_during_a_gap_is_unknown_and_left_out() -> None:
    running = RunningGyroscope()
    running.add(*constant(0.0, 1.0))
    R_a = running.R_inertial_camera(0.9)
    running.add(*constant(2.0, 3.0))
    assert running.R_inertial_camera(2.1) is None
    R_b, R_c = running.R_inertial_camera(2.2), running.R_inertial_camera(2.3)
    assert angle(R_b, R_c, VELOCITY * 0.1) < 1e-9
    assert angle(R_a, R_c, VELOCITY * 0.2) < 1e-9


@pytest.mark.parametrize("start_s", [-5000.0, 1.7e9], ids=["back", "forward"])
def test_another_time_begins_again(start_s: float) -> None:
    running = RunningGyroscope()
    running.add(*constant(0.0, 1.0))
    assert running.R_inertial_camera(0.9) is not None
    running.add(*constant(start_s, start_s + 1.0))
    assert running.R_inertial_camera(start_s + 0.3) is None
    R_a, R_b = running.R_inertial_camera(start_s + 0.4), running.R_inertial_camera(start_s + 0.5)
    assert angle(R_a, R_b, VELOCITY * 0.1) < 1e-5


def test_an_image_after_a_long_pause_has_no_rotation() -> None:
    running = RunningGyroscope()
    running.add(*constant(0.0, 1.0))
    assert running.R_inertial_camera(0.9) is not None
    running.add(*constant(1.0, KEPT_S + 3.0))
    assert running.R_inertial_camera(KEPT_S + 2.0) is None
    assert running.R_inertial_camera(KEPT_S + 2.1) is not None


def test_unusable_samples_are_left_out() -> None:
    times_s, rates = constant(0.0, 1.0)
    broken = rates.copy()
    broken[::7], broken[3::50], broken[5::50] = np.nan, np.inf, 57 * VELOCITY
    running = RunningGyroscope()
    running.add(times_s[::-1], broken[::-1])
    running.add(times_s[-15:], -rates[-15:])  # again: not later than the newest one
    assert angle(running.R_inertial_camera(0.2), running.R_inertial_camera(0.8), VELOCITY * 0.6) < 1e-9
    silent = RunningGyroscope()
    assert silent.R_inertial_camera(0.0) is None
    silent.add(np.zeros(0), np.zeros((0, 3)))
    silent.add(times_s, np.zeros_like(rates))
    assert silent.R_inertial_camera(0.5) is None, "only zeros"


def test_the_memory_of_samples_is_bounded() -> None:
    recent = RecentSamples()
    for first_s in range(60):
        recent.add(*constant(first_s, first_s + 1))
    assert len(recent.times_s) == len(recent.values) <= KEPT_S / 0.005 + 2


def test_a_running_accelerometer_averages_the_samples_so_far() -> None:
    running, up = RunningAccelerometer(), np.array([0.0, -9.81, 0.0])
    assert running.at(0.0) is None
    times_s = np.arange(0.0, 1.0, 0.004)
    shaken = up + np.where(np.arange(len(times_s)) % 2, 1.0, -1.0)[:, None] * [3.0, 0.0, 1.0]
    running.add(times_s, shaken)
    for image_s in (0.5, times_s[-1]):
        np.testing.assert_allclose(running.at(image_s), up, atol=0.15)
    assert running.at(1.5) is None
    without_gravity = RunningAccelerometer()
    without_gravity.add(times_s, shaken - up)
    assert without_gravity.at(0.5) is None
