"""The synthetic room with the faults of a real camera: calibration, depth, fall-off, exposure and white balance."""

import numpy as np
import pytest

from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.sources.room.capture import MOVE_FRAMES, STEP_FRAMES, camera_gains, misread_depth

FRAMES, FRAME = 60, 7
SIZE = {"frames": FRAMES, "width": 80, "height": 60, "exposure_change": False}
FAULTS = ("focal", "center_x", "center_y", "depth_scale", "depth_offset", "falloff", "exposure", "white")
MID = (0.05, 0.6)
"""Colours that no fault here clips, and that rounding changes little."""


@pytest.fixture(scope="module")
def plain() -> SyntheticRoom:
    return SyntheticRoom(**SIZE)


def ratio(of: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the ratio of the mean colours [3] where both are far from black and white."""
    mid = ((to > MID[0]) & (to < MID[1])).all(-1)
    return np.asarray(of[mid].mean(0) / to[mid].mean(0))


def test_without_faults_the_bytes_are_the_same(plain: SyntheticRoom) -> None:
    none = SyntheticRoom(**SIZE, **dict.fromkeys(FAULTS, 0.0))
    for one, other in zip(*([room.frame(FRAME)] for room in (plain, none)), strict=True):
        assert one.color.tobytes() == other.color.tobytes() and one.depth_m.tobytes() == other.depth_m.tobytes()
    assert none.camera == plain.camera and none.sensor == plain.sensor == "rendered" and (none.gains == 1).all()


@pytest.mark.parametrize("options", [{"late": 0.02, "rows": 0.03}, {"noise": True}, {"mover": 20}])
def test_the_stated_camera_is_wrong_and_images_are_those_of_the_true_one(options: dict) -> None:
    plain = SyntheticRoom(**SIZE, **options)
    room = SyntheticRoom(**SIZE, **options, focal=0.02, center_x=5.0, center_y=-2.5)
    true, stated, seen, exact = plain.camera, room.camera, room.frame(FRAME), plain.frame(FRAME)
    assert seen.camera == stated and room.sensor is None
    assert (stated.fx, stated.fy) == pytest.approx((1.02 * true.fx, 1.02 * true.fy))
    assert (stated.cx - true.cx, stated.cy - true.cy) == pytest.approx((5.0, -2.5))
    assert seen.color.tobytes() == exact.color.tobytes() and seen.depth_m.tobytes() == exact.depth_m.tobytes()
    np.testing.assert_array_equal(room.moving_of(FRAME), plain.moving_of(FRAME))
    # A point that is back-projected with the stated camera is off by the shift, and nearer to the axis by the share.
    wrong, right = (camera.rays() * seen.depth_m[..., None] for camera in (stated, true))
    off = seen.depth_m[..., None] * np.array([5.0, -2.5]) / true.fx
    np.testing.assert_allclose(1.02 * wrong[..., :2], right[..., :2] - off, atol=1e-5)


def test_the_truth_stays(plain: SyntheticRoom) -> None:
    room = SyntheticRoom(
        **SIZE, noise=True, focal=0.05, center_x=3.0, center_y=2.0, depth_scale=0.02, depth_offset=0.01, falloff=0.4,
        exposure=0.3, white=0.1,
    )  # fmt: skip
    np.testing.assert_array_equal(room.exact_depth_of(FRAME), plain.frame(FRAME).depth_m)
    np.testing.assert_array_equal(room.truth().T_world_camera, plain.truth().T_world_camera)
    np.testing.assert_array_equal(room.true_surface().vertices, plain.true_surface().vertices)
    one, other = (r.views_away(1, np.full(3, 0.2), np.full(3, 0.1)) for r in (room, plain))
    assert one.camera == other.camera == plain.camera
    assert one.frame(0).color.tobytes() == other.frame(0).color.tobytes()
    assert one.frame(0).depth_m.tobytes() == other.frame(0).depth_m.tobytes()


@pytest.mark.parametrize("noise", [False, True])
def test_depth_is_too_far_by_the_share_and_its_inverse_too_large_by_the_offset(noise: bool) -> None:
    exact_m = SyntheticRoom(**SIZE, noise=noise).frame(FRAME).depth_m
    read = exact_m > 0
    for scale, offset in ((0.01, 0.0), (0.0, 0.01), (-0.02, -0.03)):
        room = SyntheticRoom(**SIZE, noise=noise, depth_scale=scale, depth_offset=offset)
        depth_m = room.frame(FRAME).depth_m
        assert depth_m.dtype == np.float32 and room.sensor is None
        np.testing.assert_array_equal(depth_m > 0, read)
        np.testing.assert_allclose(1 / depth_m[read], 1 / ((1 + scale) * exact_m[read]) + offset, rtol=1e-5)


def test_depth_beyond_infinity_is_no_reading() -> None:
    read = misread_depth(np.array([[0.0, 2.0, 5.0, 9.0]], np.float32), 0.0, -0.2)
    np.testing.assert_allclose(read, [[0.0, 2 / 0.6, 0.0, 0.0]], rtol=1e-6)


def test_depth_of_stereo_and_of_a_network_is_misread_too() -> None:
    for options in ({"predicted": True}, {"stereo": 10}):
        exact, room = SyntheticRoom(**SIZE, **options), SyntheticRoom(**SIZE, **options, depth_scale=0.1)
        np.testing.assert_allclose(room.frame(FRAME).depth_m, 1.1 * exact.frame(FRAME).depth_m, rtol=1e-6)


def test_stereo_depth_follows_the_stated_focal_length() -> None:
    exact, room = SyntheticRoom(**SIZE, stereo=10), SyntheticRoom(**SIZE, stereo=10, focal=0.02)
    one_m, other_m = exact.frame(FRAME).depth_m, room.frame(FRAME).depth_m
    both = (one_m > 0) & (other_m > 0)
    assert both.any()
    np.testing.assert_allclose(other_m[both], 1.02 * one_m[both], rtol=1e-5)


def test_corners_are_darker_by_the_share_and_the_centre_is_not(plain: SyntheticRoom) -> None:
    room, v, u = SyntheticRoom(**SIZE, falloff=0.4), *np.indices((60, 80))
    square = ((v - 29.5) ** 2 + (u - 39.5) ** 2) / (29.5**2 + 39.5**2)
    bright, dark = plain.frame(FRAME), room.frame(FRAME)
    np.testing.assert_allclose(dark.color, bright.color * (1 - 0.4 * square)[..., None], atol=1.01 / 255)
    np.testing.assert_allclose(dark.color[::59, ::79], 0.6 * bright.color[::59, ::79], atol=1.01 / 255)
    assert dark.depth_m.tobytes() == bright.depth_m.tobytes() and room.camera == plain.camera
    assert (SyntheticRoom(frames=1, width=1, height=1, falloff=0.4).frame(0).depth_m > 0).all()


def test_exposure_goes_in_steps_that_colours_follow(plain: SyntheticRoom) -> None:
    room = SyntheticRoom(**SIZE, exposure=0.2)
    np.testing.assert_array_equal(room.gains[:, :1], room.gains[:, 1:2])
    levels = np.log(room.gains[:, 0])
    far = int(np.abs(levels - levels[0]).argmax())
    assert abs(levels[far] - levels[0]) > 0.05
    for i in (0, far):
        np.testing.assert_allclose(ratio(room.frame(i).color, plain.frame(i).color), room.gains[i], rtol=0.01)
    assert room.frame(far).depth_m.tobytes() == plain.frame(far).depth_m.tobytes()


def test_white_balance_moves_red_and_blue_in_opposite_directions(plain: SyntheticRoom) -> None:
    room = SyntheticRoom(**SIZE, white=0.2)
    red, green, blue = room.gains.T
    assert (green == 1).all() and np.ptp(red) > 0.05
    np.testing.assert_allclose(red + blue, 2.0)
    i = int(np.abs(red - 1).argmax())
    np.testing.assert_allclose(ratio(room.frame(i).color, plain.frame(i).color), room.gains[i], rtol=0.01)


def test_steps_of_the_gains_are_seldom_bounded_and_short() -> None:
    gains = camera_gains(6000, 3, 0.2, 0.05, False)
    level, tint = np.log(gains[:, 1]), gains[:, 0] / gains[:, 1] - 1
    for values, most in ((level, 0.2), (tint, 0.05)):
        assert 0.95 * most < np.abs(values).max() <= most and abs(values.mean()) < 0.1 * most
        moves = np.abs(np.diff(values)) > 1e-12
        starts = (moves[1:] & ~moves[:-1]).sum()  # one step in four begins before the one before has ended
        assert 0.7 < starts * STEP_FRAMES / 6000 < 1.0 and moves.mean() < 1.0 * MOVE_FRAMES / STEP_FRAMES
    assert abs(np.corrcoef(level, tint)[0, 1]) < 0.15
    np.testing.assert_array_equal(camera_gains(100, 3, 0.2, 0.05, False), gains[:100])
    assert (camera_gains(100, 4, 0.2, 0.05, False) != gains[:100]).any()


def test_steps_replace_the_sine() -> None:
    size = SIZE | {"exposure_change": True}
    sine = SyntheticRoom(**size).gains
    assert sine.max() == pytest.approx(1.08, abs=1e-3) and (sine[:, :1] == sine).all()
    np.testing.assert_array_equal(SyntheticRoom(**size, white=0.1).gains, SyntheticRoom(**SIZE, white=0.1).gains)
    corridor = SyntheticRoom(frames=60, width=16, height=12, corridor=True, exposure=0.2)
    np.testing.assert_array_equal(corridor.gains, SyntheticRoom(**SIZE, exposure=0.2).gains)


def test_noise_does_not_grow_with_the_gain() -> None:
    clean, noisy = (SyntheticRoom(**SIZE, exposure=0.6, falloff=0.3, noise=n).frame(FRAME).color for n in (False, True))
    mid = (clean > MID[0]) & (clean < MID[1])
    assert (noisy - clean)[mid].std() == pytest.approx(0.008, rel=0.05)


def test_faults_in_the_path() -> None:
    values = (-0.02, 5.0, -5.5, 0.01, 0.015, 0.4, 0.2, 0.05)
    text = ",".join(f"{key}={value:g}" for key, value in zip(FAULTS, values, strict=True))
    source = open_source(f"synthetic:frames=60,width=80,height=60,exposure_change=0,{text}")
    room = SyntheticRoom(**SIZE, **dict(zip(FAULTS, values, strict=True)))
    one, other = source.frame(FRAME), room.frame(FRAME)
    assert one.color.tobytes() == other.color.tobytes() and one.depth_m.tobytes() == other.depth_m.tobytes()
    assert one.camera == other.camera == source.camera


@pytest.mark.parametrize("wrong", [
    "focal", "white=", "falloff=much", "center_x=1e3", "exposure=nan", "focal=1.2.3", "center_y=--5",
    "depth_offset=inf", "focal=,", "blur=0.3", "width=80.5",
])  # fmt: skip
def test_nonsense_is_refused(wrong: str) -> None:
    with pytest.raises(SourceError, match=r"unknown option .*decimals for late, .*, white$") as refused:
        open_source(f"synthetic:{wrong}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("wrong", "said"), [
    ("focal=1", "focal is a share of size below 1, found 1.0"), ("focal=-1", "focal is a share"),
    ("depth_scale=-1.5", "depth_scale is a share"), ("falloff=40", "falloff is a share"),
    ("falloff=-0.1", "falloff must be at least 0, found -0.1"), ("exposure=2", "exposure is a share"),
    ("exposure=-0.2", "exposure must be at least 0"), ("white=1", "white is a share"), ("white=-0.1", "white must be"),
])  # fmt: skip
def test_values_out_of_range_are_refused(wrong: str, said: str) -> None:
    with pytest.raises(SourceError, match=said) as refused:
        open_source(f"synthetic:{wrong}")
    assert "\n" not in str(refused.value)
