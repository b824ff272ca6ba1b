"""Gyroscopes in bags and phone recordings: their axes, their clock, their bias, and what is not used."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bag_recordings import Recorder, aligned
from recordings import Scene, scene, write_stray
from sigmasplat.data import se3
from sigmasplat.input.imu import gyroscope_from_samples, still_bias
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source

COLOR_FRAME, IMU_FRAME = "camera_color_optical_frame", "camera_imu_frame"
VELOCITY = np.array([0.2, 1.5, -0.4])
"""Angular velocity of the camera about its own axes, rad/s."""
T_COLOR_IMU = se3.exp(np.array([0.02, -0.01, 0.005, 1.2, -0.7, 2.0]))


def turned(source: Source, seen: Scene) -> None:
    """Check the rotation between the first and the last frame."""
    first, last = source.frame(0).R_inertial_camera, source.frame(3).R_inertial_camera
    assert first is not None and last is not None
    expected = Rotation.from_rotvec(VELOCITY * (seen.times_s[3] - seen.times_s[0])).as_matrix()
    np.testing.assert_allclose(first.T @ last, expected, atol=1e-6)


def times(seen: Scene) -> np.ndarray:
    return np.arange(seen.times_s[0] - 0.01, seen.times_s[-1] + 0.02, 0.005)


def bag(tmp_path: Path, kind: str = "ros2", topic: str = "/camera/imu", frame: str = IMU_FRAME, link: bool = True,
        rates: np.ndarray = VELOCITY, unknown: bool = False, late_s: float = 0.0, stamped: bool = True,
        shift_s: float = 0.0) -> tuple[Source, Scene]:  # fmt: skip
    seen = scene((32, 24))
    recorder = aligned(Recorder(ros1=kind == "ros1"), seen)
    if link:
        recorder.transform("/tf_static", seen.times_s[0], COLOR_FRAME, IMU_FRAME, T_COLOR_IMU)
    axes = T_COLOR_IMU[:3, :3] if frame == IMU_FRAME else np.eye(3)
    for t in times(seen) + shift_s:
        stamp = t if stamped else 0.0
        recorder.imu(topic, stamp, axes.T @ rates, frame, late_s=late_s + t - stamp, unknown=unknown)
    path = recorder.write(tmp_path / ("walk.bag" if kind == "ros1" else "walk"))
    return open_source(path), seen


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_a_bags_gyroscope_is_turned_to_the_axes_of_the_colour_camera(tmp_path: Path, kind: str) -> None:
    turned(*bag(tmp_path, kind))


def test_a_gyroscope_in_the_frame_of_the_camera_needs_no_transform(tmp_path: Path) -> None:
    turned(*bag(tmp_path, frame=COLOR_FRAME, link=False))


def test_header_times_are_used_and_recording_times_if_the_headers_are_empty(tmp_path: Path) -> None:
    turned(*bag(tmp_path / "late", late_s=0.2))
    turned(*bag(tmp_path / "empty", stamped=False))


@pytest.mark.parametrize(
    "changes",
    [{"link": False}, {"unknown": True}, {"rates": np.zeros(3)}, {"rates": VELOCITY * 57}, {"shift_s": 500.0}],
    ids=["axes not known", "no angular velocity", "only zeros", "degrees", "another clock"],
)
def test_a_gyroscope_that_cannot_be_used_does_not_stop_a_run(tmp_path: Path, changes: dict) -> None:
    source, _ = bag(tmp_path, **changes)
    assert [frame.R_inertial_camera for frame in source] == [None] * 4


def test_the_gyroscope_of_the_cameras_device_is_preferred(tmp_path: Path) -> None:
    seen = scene((32, 24))
    recorder = aligned(Recorder(), seen)
    for t in times(seen):
        recorder.imu("/camera/imu", t, VELOCITY, COLOR_FRAME)
        for late in (0.0, 0.001):  # more messages, wrong velocities
            recorder.imu("/base/imu", t + late, -VELOCITY, COLOR_FRAME)
    turned(open_source(recorder.write(tmp_path / "walk")), seen)


def test_a_bag_of_realsenses_sdk(tmp_path: Path) -> None:
    """Its transforms are from a reference to each stream."""
    seen, recorder = scene((32, 24)), Recorder(ros1=True)
    color, depth, gyro = ("/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0", "/device_0/sensor_2/Gyro_0")
    for rgb, millimetres, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
        recorder.image(f"{color}/image/data", t, rgb, "rgb8", "0")
        recorder.image(f"{depth}/image/data", t, millimetres, "mono16", "0")
    for stream in (color, depth):
        recorder.info(f"{stream}/info/camera_info", seen.times_s[0], (32, 24), (40.0, 40.0, 16.0, 12.0), "0")
        recorder.add(f"{stream}/tf/0", seen.times_s[0], recorder.moved(np.eye(4)))
    recorder.add(f"{gyro}/tf/0", seen.times_s[0], recorder.moved(se3.inverse(T_COLOR_IMU)))
    for t in times(seen):
        recorder.imu(f"{gyro}/imu/data", t, T_COLOR_IMU[:3, :3].T @ VELOCITY, "0")
    turned(open_source(recorder.write(tmp_path / "sdk.bag")), seen)


# ---- Stray Scanner ----


def stray(tmp_path: Path, lines: list[str]) -> Source:
    folder = write_stray(tmp_path / "scan", scene((64, 48), (32, 24)))
    (folder / "imu.csv").write_text("\n".join(["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", *lines]))
    return open_source(folder)


def test_a_phones_gyroscope_is_turned_to_the_axes_of_its_camera(tmp_path: Path) -> None:
    """Held upright, a phone has x right, y up, z towards the user; the image's x points from its top to its bottom."""
    seen = scene((64, 48), (32, 24))
    x, y, z = VELOCITY
    lines = [f"{t:.6f}, 0.1, 0.2, -9.8, {-y}, {-x}, {-z}" for t in times(seen)]
    turned(stray(tmp_path, [*lines[:3], "damaged, line", *lines[3:], lines[-1], "1000.2, 0.1"]), seen)


def test_a_phones_samples_of_another_time_are_not_used(tmp_path: Path) -> None:
    source = stray(tmp_path, [f"{t}, 0, 0, 0, 1, 0, 0" for t in (1.0, 2.0)])
    assert source.frame(0).R_inertial_camera is None


# ---- bias ----


def samples(still: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, rates and the bias: 3 s at rest (or shaken), then 3 s of turning."""
    rng, t, bias = np.random.default_rng(1), np.arange(0, 6, 0.005), np.array([0.02, -0.01, 0.015])
    turn = np.where(t > 3, 1.0, 0.0)[:, None] * VELOCITY
    noise = rng.normal(0, 0.003 if still else 0.1, (len(t), 3))
    return t, turn + noise + bias, bias


def test_the_bias_is_measured_while_the_camera_rests_and_removed() -> None:
    t, rates, bias = samples(still=True)
    np.testing.assert_allclose(still_bias(t, rates), bias, atol=5e-4)
    gyroscope = gyroscope_from_samples(t, rates)
    assert gyroscope is not None
    first, last = gyroscope.R_inertial_camera(0.5), gyroscope.R_inertial_camera(2.5)
    assert first is not None and last is not None
    assert se3.rotation_angle(first.T @ last) < 0.002 < 0.05 < np.linalg.norm(bias) * 2


def test_without_rest_no_bias_is_removed() -> None:
    t, rates, _ = samples(still=False)
    assert not still_bias(t, rates).any()
    assert not still_bias(t[t > 3], samples(still=True)[1][t > 3]).any(), "a steady turn is no bias"


def test_unsorted_repeated_and_infinite_samples_are_put_right() -> None:
    t = np.array([0.2, 0.0, 0.1, 0.1, 0.15])
    rates = np.tile(VELOCITY, (5, 1))
    rates[4] = np.nan
    gyroscope = gyroscope_from_samples(t, rates)
    assert gyroscope is not None and gyroscope.timestamps_s.tolist() == [0.0, 0.1, 0.2]
    assert gyroscope_from_samples(t[:1], rates[:1]) is None
