"""Accelerometers: the mean around an image, what is not used, and the vertical direction of a path."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bag_recordings import Recorder, aligned
from box_room import CAMERA, seer, splats, walk
from recordings import scene, write_stray
from sigmasplat.config.find_preset import preset
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError, SourceError
from sigmasplat.input.imu import Accelerometer, accelerometer_from_samples, up_of_path
from sigmasplat.input.source import Source
from sigmasplat.plugins.outputs.axes import level_cameras
from sigmasplat.plugins.outputs.floorplan.ground import MEASURED_COS, Up, floor_frame, sample_surfaces, up_of
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.frames import RunFrames, noted_up
from sigmasplat.run_folder.runs import RunFolder

WORLD = se3.exp(np.array([3.0, -2.0, 1.0, 1.9, 0.4, -0.3]))
UP = np.array([0.2, -0.9, 0.4]) / np.linalg.norm([0.2, -0.9, 0.4])
"""Up in a world whose first camera was tilted."""
T_COLOR_IMU = se3.exp(np.array([0.02, -0.01, 0.005, 1.2, -0.7, 2.0]))


def held(frames: int = 300, rate_hz: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of a camera in a hand [N, 4, 4], and the specific forces on it [N, 3]."""
    t = np.arange(frames) / rate_hz
    sway = np.stack([0.3 * np.sin(1.1 * t), 0.05 * np.sin(9.0 * t), 0.4 * np.sin(0.7 * t + 1.0)], 1)
    acceleration = np.stack(
        [-0.363 * np.sin(1.1 * t), -4.05 * np.sin(9.0 * t), -0.196 * np.sin(0.7 * t + 1.0)], 1
    )  # of `sway`
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.stack([0.5 * np.sin(t), 1.5 * np.sin(0.4 * t), t / 3], 1)).as_matrix()
    poses[:, :3, 3] = sway
    return poses, np.einsum("nji,nj->ni", poses[:, :3, :3], acceleration + 9.81 * UP)


def test_the_samples_around_an_image_are_averaged() -> None:
    times = np.arange(0.0, 1.0, 0.01)
    found = Accelerometer(times, np.stack([times, 2 * times, np.full_like(times, 9.81)], 1))
    np.testing.assert_allclose(found.at(0.5051), [0.505, 1.01, 9.81], atol=1e-9)
    assert found.at(-0.2) is None and found.at(1.2) is None


def test_samples_that_do_not_measure_gravity_are_not_used() -> None:
    times = np.arange(0.0, 1.0, 0.01)
    gravity = np.tile(9.81 * UP, (100, 1))
    assert accelerometer_from_samples(times, gravity / 9.81) is None, "in g"
    assert accelerometer_from_samples(times, gravity * 0.03) is None, "without gravity"
    assert accelerometer_from_samples(times[:0], gravity[:0]) is None
    mixed = gravity.copy()
    mixed[3] = np.nan
    found = accelerometer_from_samples(np.r_[times[50:], times[:50]], mixed)
    assert found is not None and len(found.timestamps_s) == 99 and (np.diff(found.timestamps_s) > 0).all()


def test_the_vertical_direction_of_a_path_is_that_of_the_mean_force() -> None:
    poses, forces = held()
    up = up_of_path(poses, forces + np.random.default_rng(0).normal(0, 0.2, forces.shape))
    assert up is not None and np.linalg.norm(up) == pytest.approx(1.0)
    assert np.rad2deg(np.arccos(up @ UP)) < 1.0
    assert up_of_path(poses[:5], forces[:5]) is None, "too few frames"
    turned = poses.copy()
    turned[:, :3, :3] = Rotation.random(len(poses), random_state=1).as_matrix()
    assert up_of_path(turned, forces) is None, "poses of another path"


@pytest.mark.parametrize("rolled_deg", [90.0, 180.0])
def test_a_map_of_a_camera_that_was_held_sideways_stands_upright(rolled_deg: float) -> None:
    path = walk(WORLD)
    poses = path.T_world_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", rolled_deg, degrees=True).as_matrix()
    sideways, up = Trajectory(path.timestamps_s, poses), WORLD[:3, 2]
    samples = list(sample_surfaces(splats(WORLD), sideways, CAMERA, seer(WORLD), max_poses=8))
    measured = Rotation.from_rotvec([0.03, -0.02, 0.03]).apply(up)  # 3 degrees off
    assert floor_frame(samples)[2, :3] @ up < 0.1, "the camera alone misleads"
    edge = {90.0: "left", 180.0: "bottom"}[rolled_deg]
    told = up_of(poses, edge=edge)
    assert floor_frame(samples, told)[2, :3] @ up > np.cos(np.deg2rad(0.2)) and edge in told.how
    assert floor_frame(samples, Up(measured, MEASURED_COS, ""))[2, :3] @ up > np.cos(np.deg2rad(0.2))
    np.testing.assert_allclose(level_cameras(sideways, Up(measured, MEASURED_COS, ""))[2], measured, atol=1e-12)


def test_a_run_knows_up_by_the_forces_on_its_valid_frames(tmp_path: Path) -> None:
    poses, forces = held()
    log = [
        {"timestamp_s": i / 30, "state": "lost" if i % 7 == 3 else "tracked", "lost": i % 7 == 3, "is_keyframe": False}
        | ({} if i % 5 == 1 else {"specific_force_m_s2": (forces[i] if i % 7 != 3 else -forces[i]).tolist()})
        for i in range(len(poses))
    ]
    valid = [i for i in range(len(poses)) if i % 7 != 3]
    frames = RunFrames.of(log, Trajectory(np.array(valid) / 30, poses[valid]))
    up = frames.measured_up()
    assert up is not None and np.rad2deg(np.arccos(up @ UP)) < 1.5
    run = RunFolder.create(tmp_path / "run", preset("sigma"), "x")
    assert noted_up(run.facts()) is None
    run.note(up_world=up.tolist())
    np.testing.assert_allclose(noted_up(run.facts()), up)
    for wrong in ([0, 0, 0], [1, 2], "up", [1, None, 2]):
        text = (run.path / "run.json").read_text()
        run.note(up_world=wrong)
        with pytest.raises(RunError, match="up_world"):
            noted_up(run.facts())
        (run.path / "run.json").write_text(text)


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
@pytest.mark.parametrize("apart", [False, True])
def test_a_bags_accelerometer_is_turned_to_the_axes_of_the_colour_camera(
    tmp_path: Path, kind: str, apart: bool
) -> None:
    """RealSense's driver publishes the two sensors in two topics."""
    seen, frame = scene((32, 24)), "camera_imu_frame"
    recorder = aligned(Recorder(ros1=kind == "ros1"), seen)
    recorder.transform("/tf_static", seen.times_s[0], "camera_color_optical_frame", frame, T_COLOR_IMU)
    rates, force = np.array([0.2, 1.5, -0.4]), np.array([0.1, 0.3, 9.8])
    for t in np.arange(seen.times_s[0] - 0.01, seen.times_s[-1] + 0.02, 0.005):
        if apart:
            recorder.imu("/camera/gyro", t, rates, frame)
            recorder.imu("/camera/accel", t, rates, frame, unknown=True, force=force)
        else:
            recorder.imu("/camera/imu", t, rates, frame, force=force)
    source = open_source(recorder.write(tmp_path / ("walk.bag" if kind == "ros1" else "walk")))
    for i in range(len(source)):
        measured = source.frame(i)
        assert measured.R_inertial_camera is not None
        np.testing.assert_allclose(measured.specific_force_m_s2, T_COLOR_IMU[:3, :3] @ force, atol=1e-9)


def stray(tmp_path: Path, columns: str, values: str) -> Source:
    seen = scene((32, 24))
    folder = write_stray(tmp_path / "walk", seen)
    times = np.arange(seen.times_s[0] - 0.01, seen.times_s[-1] + 0.02, 0.01)
    (folder / "imu.csv").write_text(columns + "\n" + "".join(f"{t}, {values}\n" for t in times))
    return open_source(folder)


def test_a_phone_held_upright_has_up_at_the_left_of_its_image(tmp_path: Path) -> None:
    """Apple gives g, with the sign of gravity; the image's x points from the top of the phone to its bottom."""
    names = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"
    measured = stray(tmp_path, names, "0.0, -1.0, 0.0, 0.1, 0.0, 0.0").frame(1).specific_force_m_s2
    np.testing.assert_allclose(measured, [-9.81, 0.0, 0.0], atol=1e-9)
    without = stray(tmp_path / "moved", names, "0.01, -0.02, 0.0, 0.1, 0.0, 0.0").frame(1)
    assert without.specific_force_m_s2 is None and without.R_inertial_camera is not None, "gravity was removed"
    assert stray(tmp_path / "none", "timestamp, b", "1.0").frame(1).specific_force_m_s2 is None


@pytest.mark.parametrize("force", [np.zeros(2), np.array([0.0, np.nan, 9.8])])
def test_a_frame_refuses_a_force_that_is_not_three_finite_numbers(force: np.ndarray) -> None:
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    image, depth = np.zeros((6, 8, 3), np.float32), np.ones((6, 8), np.float32)
    with pytest.raises(SourceError, match="specific_force_m_s2"):
        Frame(0, 0.0, image, depth, camera, specific_force_m_s2=force)
