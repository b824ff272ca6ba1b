"""A gyroscope: angular velocities integrate to rotations between any two times, and frames carry the rotation."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from paper_settings import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.input.imu import Gyroscope
from sigmasplat.plugins.checks.recording import inspect_source
from sigmasplat.plugins.sources import open_source

CAMERA = Camera(8, 6, 7.0, 6.5, 3.2, 2.9)


def frame(R_inertial_camera=None) -> Frame:
    return Frame(4, 0.0, np.zeros((6, 8, 3), np.float32), np.ones((6, 8), np.float32), CAMERA, R_inertial_camera)


def between(gyroscope: Gyroscope, a_s: float, b_s: float):
    """Return R_a_b."""
    return gyroscope.R_inertial_camera(a_s).T @ gyroscope.R_inertial_camera(b_s)


def test_a_constant_velocity_gives_its_rotation_vector_at_any_times():
    velocity = np.array([0.3, -1.1, 0.7])
    gyroscope = Gyroscope(5.0 + np.array([0.0, 0.013, 0.2, 0.21, 1.0]), np.tile(velocity, (5, 1)))
    for a_s, b_s in [(5.0, 6.0), (5.1, 5.1), (5.004, 5.205), (5.9, 5.3)]:
        expected = Rotation.from_rotvec(velocity * (b_s - a_s)).as_matrix()
        np.testing.assert_allclose(between(gyroscope, a_s, b_s), expected, atol=1e-12)


def test_a_turn_about_a_turning_axis_agrees_with_its_closed_form():
    """R(t) = Rz(at) Rx(bt): the velocity in the camera's own axes is b x + a Rx(bt)ᵀ z."""
    a, b, t = 2.0, 3.0, np.linspace(0.0, 1.0, 201)

    def R(t_s):
        return Rotation.from_euler("z", a * t_s) * Rotation.from_euler("x", b * t_s)

    velocity = np.stack([np.full_like(t, b), a * np.sin(b * t), a * np.cos(b * t)], -1)
    found = between(Gyroscope(t, velocity), 0.1234, 0.9)
    assert se3.rotation_angle((R(0.1234).inv() * R(0.9)).as_matrix().T @ found) < 1e-4
    assert se3.rotation_angle(found) > 1.0, "the rotation must be large for the test to be meaningful"


def test_rotations_over_several_frames_are_the_product_of_the_single_ones():
    rng = np.random.default_rng(0)
    gyroscope = Gyroscope(np.arange(50) / 100, rng.normal(size=(50, 3)))
    steps = [between(gyroscope, a_s, a_s + 0.1) for a_s in (0.03, 0.13, 0.23)]
    np.testing.assert_allclose(between(gyroscope, 0.03, 0.33), steps[0] @ steps[1] @ steps[2], atol=1e-12)


def test_outside_the_samples_nothing_is_measured():
    gyroscope = Gyroscope(np.array([1.0, 2.0]), np.zeros((2, 3)))
    assert gyroscope.R_inertial_camera(0.99) is None and gyroscope.R_inertial_camera(2.01) is None
    for time_s in (1.0, 2.0):
        np.testing.assert_array_equal(gyroscope.R_inertial_camera(time_s), np.eye(3))


@pytest.mark.parametrize(
    "times_s, velocities, words",
    [
        ([0.0, 1.0], [[0, 0, 0]], "shape"),
        ([0.0], [[0, 0, 0]], "shape"),
        ([0.0, 1.0], [[0, 0, 0], [0, np.nan, 0]], "NaN"),
        ([0.0, np.inf], [[0, 0, 0], [0, 0, 0]], "inf"),
        ([0.0, 1.0, 1.0], np.zeros((3, 3)), "sort"),
        ([0.0, 1.0], [[0, 0, 0], [0, 90, 0]], "degrees"),
    ],
)
def test_bad_samples_are_refused_with_one_line(times_s, velocities, words):
    with pytest.raises(SourceError, match=words) as raised:
        Gyroscope(np.array(times_s), np.array(velocities, float))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "matrix",
    [np.full((3, 3), np.nan), np.eye(4), 1.1 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))],
    ids=["NaN", "4×4", "scaled", "mirrored", "zero"],
)
def test_a_frame_refuses_a_matrix_that_is_not_a_rotation(matrix):
    with pytest.raises(SourceError, match="frame 4: R_inertial_camera is not a rotation") as raised:
        frame(matrix)
    assert "\n" not in str(raised.value)


def test_the_rotation_stays_with_the_frame_at_any_size():
    R = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    whole = frame(R)
    for changed in (whole.resized(4, 3), whole.prepared(4, 0.1, 0.5), whole.seen_by(CAMERA.resized(4, 3))):
        assert changed.R_inertial_camera is R
    assert replace(whole, R_inertial_camera=None).prepared(4, 0.1, 8.0).R_inertial_camera is None


# ---- gyroscope.txt


def write(folder, *lines: str) -> None:
    (folder / "gyroscope.txt").write_text("".join(line + "\n" for line in lines))


def test_gyroscope_txt_gives_each_frame_its_rotation(tiny_tum):
    assert all(f.R_inertial_camera is None for f in open_source(tiny_tum))
    write(tiny_tum, "# t wx wy wz", "-0.05 0 2 0", "0.15 0 2 0", "0.25 0 2 0")
    first, second, third, fourth = open_source(tiny_tum)
    R = first.R_inertial_camera.T @ second.R_inertial_camera
    np.testing.assert_allclose(R, Rotation.from_rotvec([0, 0.2, 0]).as_matrix(), atol=1e-12)
    # The camera turns right (about y, down): what was ahead is then on its left.
    assert (R.T @ [0, 0, 1])[0] < 0
    assert third.R_inertial_camera is not None and fourth.R_inertial_camera is None
    assert ("gyroscope", "measured 3 of 4 sampled frames") in inspect_source(tiny_tum, InputConfig()).rows


def test_the_rotation_spans_the_frames_that_are_left_out(tiny_tum):
    write(tiny_tum, "0 0 0 1", "0.1 0 0 2", "0.2 0 0 4", "0.3 0 0 4")
    (tiny_tum / "rgb/1.png").write_bytes(b"damaged")
    for settings, times_s in [({"stride": 2}, (0.0, 0.2)), ({}, (0.0, 0.2, 0.3)), ({"start_s": 0.15}, (0.2, 0.3))]:
        frames = list(open_source(tiny_tum, **settings))
        assert [f.timestamp_s for f in frames] == pytest.approx(times_s)
        angles = {0.0: 0.0, 0.2: 0.45, 0.3: 0.85}
        for a, b in pairwise(frames):
            turned = se3.rotation_angle(a.R_inertial_camera.T @ b.R_inertial_camera)
            assert turned == pytest.approx(angles[b.timestamp_s] - angles[a.timestamp_s])


@pytest.mark.parametrize(
    "lines, words",
    [
        (["0 0 0 0", "0.1 0 0"], "gyroscope.txt:2: expected"),
        (["0 0 0 0", "0.1 0 0 x"], "gyroscope.txt:2: expected numbers"),
        (["0 0 0 nan", "0.1 0 0 0"], "gyroscope.txt:1: not finite"),
        (["# t", "0.1 0 0 0", "0.1 0 0 0"], "gyroscope.txt:3: time 0.1 is not after"),
        (["0.1 0 0 0"], "gyroscope.txt: holds 1"),
        (["0 0 0 0", "0.4 0 0 70"], "gyroscope.txt: .*degrees"),
        (["1000 0 0 0", "1010 0 0 0"], "the gyroscope measured from 1000.000 to 1010.000 s"),
    ],
)
def test_a_bad_gyroscope_txt_is_refused_with_one_line(tiny_tum, lines, words):
    write(tiny_tum, *lines)
    with pytest.raises(SourceError, match=words) as raised:
        open_source(tiny_tum)
    assert "\n" not in str(raised.value)
