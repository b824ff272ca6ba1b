"""Where the camera is expected: at constant velocity, by the times of the frames."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.tracking.pose_prediction import CameraMotion

RATE = np.array([0.3, -0.1, 0.2, 0.4, 0.1, -0.3])
"""A hand: m/s and rad/s."""


@pytest.mark.parametrize("frames", [1, 2, 4, 0.5])
def test_a_camera_is_expected_to_go_as_far_as_the_time_allows(frames: float) -> None:
    """Frames are dropped in real time, or could not be read, or come when an exposure ends."""
    motion = CameraMotion(0.0).after(se3.exp(RATE / 30), 1 / 30)
    assert np.allclose(motion.until((1 + frames) / 30), se3.exp(frames * RATE / 30), atol=1e-12)


def test_evenly_timed_frames_repeat_the_last_motion_bit_by_bit() -> None:
    start_s, velocity = 1.6e9, se3.exp(RATE / 30)
    motion = CameraMotion(start_s).after(velocity, start_s + 1 / 30)
    assert motion.until(start_s + 2 / 30).tobytes() == velocity.tobytes()


def test_after_a_pause_or_without_times_the_camera_is_not_expected_far_away() -> None:
    motion = CameraMotion(0.0).after(se3.exp(RATE / 30), 1 / 30)
    assert np.allclose(motion.until(60.0), se3.exp(RATE), atol=1e-12)
    assert np.array_equal(CameraMotion(0.0).after(se3.exp(RATE), 0.0).until(0.0), se3.exp(RATE))


def test_slow_frames_and_frames_back_in_time_are_no_gap() -> None:
    """One frame in 2 s, or times in ms taken for seconds: an even step is no gap. Nothing is expected to run back."""
    slow = CameraMotion(0.0).after(se3.exp(RATE), 33.0)
    assert np.array_equal(slow.until(66.0), se3.exp(RATE)) and np.allclose(slow.until(33.0), np.eye(4))
    assert np.allclose(slow.until(20.0), np.eye(4)) and np.array_equal(slow.until(99.0), se3.exp(RATE))
