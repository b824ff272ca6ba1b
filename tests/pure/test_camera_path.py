"""Camera paths: a recorded path, smoothed and evenly resampled, and an orbit around a point."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.outputs.video import look_along, orbit, smooth_path

WORLD = se3.exp(np.array([3.0, -2.0, 1.0, 1.9, 0.4, -0.3]))


def turning(times: np.ndarray, rate: float = 1.0) -> Trajectory:
    """Return a path along x at 1 m/s that rotates about y at `rate` rad/s."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rate * np.outer(times, [0.0, 1.0, 0.0])).as_matrix()
    poses[:, 0, 3] = times
    return Trajectory(times, poses)


def test_a_path_of_constant_speed_is_unchanged_for_any_timestamps() -> None:
    """The path is sampled at uneven times and returned at even times; smoothing shortens it at its ends."""
    times = np.sort(np.random.default_rng(0).uniform(0, 6, 60))
    times[[0, -1]] = 0.0, 6.0
    found = smooth_path(turning(times), 61, smoothing_s=0.1)
    wanted = turning(np.linspace(0, 6, 61)).T_world_camera
    np.testing.assert_allclose(found[6:-6], wanted[6:-6], atol=2e-3)
    np.testing.assert_allclose(smooth_path(turning(times), 61, smoothing_s=0.0), wanted, atol=2e-3)


def test_camera_shake_is_smoothed_and_poses_stay_rigid() -> None:
    times = np.arange(0, 4, 1 / 30)
    calm, rng = turning(times), np.random.default_rng(1)
    shaken = np.stack([T @ se3.exp(rng.normal(0, 0.02, 6)) for T in calm.T_world_camera])
    found = smooth_path(Trajectory(times, shaken), len(times))
    assert all(se3.is_rigid(T, 1e-9) for T in found)

    def off(poses: np.ndarray) -> float:
        inner = slice(20, -20)
        return float(np.abs(se3.log_stack(se3.inverse(calm.T_world_camera[inner]) @ poses[inner])).mean())

    assert off(found) < 0.4 * off(shaken)


def test_several_full_turns_are_kept() -> None:
    """In three turns the quaternions change sign, and averages of opposite signs must not cancel."""
    times = np.linspace(0, 12, 200)
    found = smooth_path(turning(times, rate=np.pi / 2), 200, smoothing_s=0.1)
    steps = [se3.rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in pairwise(found[10:-10])]
    np.testing.assert_allclose(steps, np.pi / 2 * 12 / 199, rtol=0.02)


def test_one_pose_or_equal_times_give_a_path_and_no_pose_or_no_image_is_an_error() -> None:
    one = turning(np.array([2.0]))
    np.testing.assert_array_equal(smooth_path(one, 3), np.repeat(one.T_world_camera, 3, 0))
    assert len(smooth_path(turning(np.array([0.0, 0.0, 1.0])), 5)) == 5
    for path, images in ((turning(np.empty(0)), 3), (one, 0)):
        with pytest.raises(SigmaSplatError, match="cannot make a path of"):
            smooth_path(path, images)


@pytest.mark.parametrize("T", [np.eye(4), WORLD])
def test_an_orbit_is_a_closed_circle_that_looks_down_at_its_centre(T: np.ndarray) -> None:
    up, start, center = T[:3, :3] @ [0, 0, 1.0], T[:3, :3] @ [0.3, 1.0, 0.2], T[:3, :3] @ [1.0, 2.0, 0.5] + T[:3, 3]
    poses = orbit(center, up, start, 4.0, np.pi / 4 * np.arange(8), elevation_rad=np.pi / 6)
    for pose in poses:
        assert se3.is_rigid(pose, 1e-9)
        x, y, z, _ = np.linalg.inv(pose) @ np.append(center, 1.0)
        np.testing.assert_allclose([x, y, z], [0, 0, 4.0], atol=1e-9)
        assert (pose[:3, 3] - center) @ up == pytest.approx(2.0)
        assert pose[:3, 0] @ up == pytest.approx(0.0) and pose[:3, 1] @ up < 0, "level, and y down"
    angles = [se3.rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(poses, np.roll(poses, -1, 0), strict=True)]
    np.testing.assert_allclose(angles, angles[0])
    assert poses[0][:3, 2] @ start == pytest.approx(max(pose[:3, 2] @ start for pose in poses))


def test_look_along_gives_position_and_axes() -> None:
    T = look_along(np.array([1.0, 2, 3]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
    np.testing.assert_allclose(T, [[1, 0, 0, 1], [0, 0, 1, 2], [0, -1, 0, 3], [0, 0, 0, 1]], atol=1e-12)
