"""Mapping that moves its keyframes: a pose that is off is pulled back towards the truth, and otherwise left alone."""

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from map_now import map_now
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.render.backend import make_view
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
SMALL = {
    "input.width": "160",
    "mapping.first_iterations": "100",
    "mapping.iterations": "90",
    "mapping.few_steps": "false",
    "mapping.lr_means": "2e-4",
    "mapping.lr_pose_translation": "2e-4",
    "mapping.lr_pose_rotation": "1e-4",
    "mapping.weight_nll_color": "0",
}
"""The likelihood is off: through V it pulls at geometry and poses as well, by millimetres."""
OFF = se3.exp(np.concatenate([[0.003, -0.003, 0.00265], np.deg2rad([0.12, -0.12, 0.106])]))
"""5 mm and 0.2°."""


def settings(**changes: str) -> Config:
    return override(preset(default_preset()), SMALL | {k.replace("__", "."): v for k, v in changes.items()})


@cache
def room() -> SyntheticRoom:
    return SyntheticRoom(frames=200, width=160, height=120, exposure_change=False)


def true_pose(i: int) -> Array:
    """Return T_world_camera of frame i, the world being the first camera."""
    T = room().truth().T_world_camera
    return np.asarray(se3.inverse(T[0]) @ T[i]) if i else np.eye(4)


def error(T_world_camera: Array, i: int) -> tuple[float, float]:
    """Return how far a pose is from the true one, mm and degrees."""
    off = se3.inverse(true_pose(i)) @ T_world_camera
    return 1e3 * float(np.linalg.norm(off[:3, 3])), float(np.rad2deg(se3.rotation_angle(off[:3, :3])))


STILL = {"mapping__lr_pose_translation": "0", "mapping__lr_pose_rotation": "0"}


def take_in(mapper: Mapper, i: int, T_world_camera: Array) -> Keyframe:
    """Map frame i as a keyframe that stands at a pose; return it as mapping leaves it."""
    view = make_view("cpu", room().camera, mapper.config.render)
    map_now(mapper, view, i, Target.of(room().frame(i), (view.alpha.shape[0], view.alpha.shape[1])), T_world_camera)
    return mapper.keyframes[-1]


@cache
def two_held() -> Mapper:
    """Map frames 0 and 6 from where they are, and hold them there."""
    mapper = Mapper(settings(**STILL), np.random.default_rng(0))
    for i in (0, 6):
        take_in(mapper, i, true_pose(i)).fixed = True
    return mapper


def between_two(T_true_start: Array, **changes: str) -> Keyframe:
    """Let frame 3 in, put off in its own axes, between two keyframes that are right and held."""
    mapper = copy.deepcopy(two_held())
    mapper.config = settings(**changes)
    return take_in(mapper, 3, true_pose(3) @ T_true_start)


def test_a_keyframe_that_is_off_is_pulled_back() -> None:
    was_mm, was_deg = error(true_pose(3) @ OFF, 3)
    assert (was_mm, was_deg) == (pytest.approx(5.0, abs=0.05), pytest.approx(0.2, abs=0.005))
    found = between_two(OFF)
    is_mm, is_deg = error(found.T_world_camera, 3)
    assert is_mm < 3.0 and is_deg < 0.1, f"{is_mm:.2f} mm, {is_deg:.3f}°"
    assert 20 < found.motion.steps < 60 and se3.is_rigid(found.T_world_camera, 1e-9)


def test_a_keyframe_that_is_right_stays_about_there() -> None:
    is_mm, is_deg = error(between_two(np.eye(4)).T_world_camera, 3)
    assert is_mm < 1.5 and is_deg < 0.05, f"{is_mm:.2f} mm, {is_deg:.3f}°"


@pytest.mark.parametrize("moving", ["translation", "rotation"])
def test_either_half_may_move_alone(moving: str) -> None:
    other = {"translation": "rotation", "rotation": "translation"}[moving]
    found = between_two(OFF, mapping__iterations="10", **{f"mapping__lr_pose_{other}": "0"})
    # The step is on the left of T_camera_world: along and about the camera's own axes.
    moved = se3.inverse(true_pose(3) @ OFF) @ found.T_world_camera
    turned, shifted = np.abs(moved[:3, :3] - np.eye(3)).max(), np.abs(moved[:3, 3]).max()
    assert bool(turned > 1e-5) is (moving == "rotation")
    assert bool(shifted > 1e-5) is (moving == "translation")


def test_at_rate_zero_poses_stay_to_the_bit() -> None:
    found = between_two(OFF, **STILL, mapping__iterations="10")
    assert found.T_world_camera.tobytes() == (true_pose(3) @ OFF).tobytes() and found.motion.steps == 0


def test_the_first_keyframe_is_the_world_and_stays() -> None:
    mapper = Mapper(settings(mapping__iterations="10", mapping__few_steps="true"), np.random.default_rng(0))
    first = take_in(mapper, 0, np.eye(4))
    second = take_in(mapper, 3, true_pose(3) @ OFF)
    assert first.fixed and first.T_world_camera.tobytes() == np.eye(4).tobytes()
    assert not second.fixed and not np.array_equal(second.T_world_camera, true_pose(3) @ OFF)


def followed(**changes: str) -> tuple[Slam, list[Any]]:
    slam = Slam(settings(mapping__first_iterations="40", mapping__iterations="10", final__move_poses="no", **changes))
    return slam, [slam.step(room().frame(i)) for i in range(13)]


def test_frames_follow_their_keyframe_where_mapping_moves_it() -> None:
    slam, steps = followed()
    path, keyframes = slam.trajectory(), slam.mapper.keyframes
    moved = [k for k in keyframes if not np.array_equal(path.T_world_camera[k.index], steps[k.index].T_world_camera)]
    assert moved and 0 not in [k.index for k in moved], "a later fit moves earlier keyframes, never the first"
    for k, upper in zip(keyframes, [*(k.index for k in keyframes[1:]), len(steps)], strict=True):
        np.testing.assert_allclose(path.T_world_camera[k.index], k.T_world_camera, atol=1e-12)
        T_then = steps[k.index].T_world_camera
        for i in range(k.index, upper):
            relative = se3.inverse(T_then) @ steps[i].T_world_camera
            now = se3.inverse(k.T_world_camera) @ path.T_world_camera[i]
            np.testing.assert_allclose(now, relative, atol=1e-9)


def test_with_fixed_poses_the_path_is_that_of_the_steps() -> None:
    slam, steps = followed(**STILL)
    for step, T_world_camera in zip(steps, slam.trajectory().T_world_camera, strict=True):
        np.testing.assert_allclose(T_world_camera, step.T_world_camera, atol=1e-12)
