"""Mapping that moves its keyframes: a pose that is off is pulled back towards the truth, and otherwise left alone."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.presets import default_preset, override, preset
from sigmasplat.render.view import make_view
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import SyntheticRoom

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
SMALL = {
    "input.width": "160",
    "mapping.first_iterations": "150",
    "mapping.iterations": "100",
    "mapping.lr_pose_translation": "2e-4",
    "mapping.lr_pose_rotation": "1e-4",
}
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


def mapped(config: Config, offsets: dict[int, Array]) -> Mapper:
    """Map keyframes at their true poses, each put off by its offset in its own axes."""
    mapper = Mapper(config, np.random.default_rng(0))
    view = make_view("cpu", room().camera, config.render)
    size = (view.alpha.shape[0], view.alpha.shape[1])
    for i, T_true_off in offsets.items():
        mapper.map(view, i, Target.of(room().frame(i), size), true_pose(i) @ T_true_off)
    return mapper


def test_a_keyframe_that_is_off_is_pulled_back() -> None:
    exactly = np.eye(4)
    mapper = mapped(settings(), {0: exactly, 5: exactly, 10: OFF})
    first, second, third = (k.T_world_camera for k in mapper.keyframes)
    (was_mm, was_deg), (is_mm, is_deg) = error(true_pose(10) @ OFF, 10), error(third, 10)
    assert (was_mm, was_deg) == (pytest.approx(5.0, abs=0.05), pytest.approx(0.2, abs=0.005))
    assert is_mm < 0.5 * was_mm and is_deg < 0.5 * was_deg, f"{is_mm:.2f} mm, {is_deg:.3f}°"
    np.testing.assert_array_equal(first, np.eye(4))  # the first keyframe is the world
    assert mapper.keyframes[0].motion.steps == 0 < mapper.keyframes[1].motion.steps
    assert error(second, 5)[0] < 3.0 and error(second, 5)[1] < 0.12, "one that is right is not dragged away"
    assert all(se3.is_rigid(k.T_world_camera, 1e-9) for k in mapper.keyframes)


@pytest.mark.parametrize("moving", ["translation", "rotation"])
def test_either_half_may_move_alone(moving: str) -> None:
    other = {"translation": "rotation", "rotation": "translation"}[moving]
    config = settings(**{f"mapping__lr_pose_{other}": "0", "mapping__iterations": "20"})
    start = true_pose(5) @ OFF
    T = mapped(config, {0: np.eye(4), 5: OFF}).keyframes[1].T_world_camera
    # T_camera_world steps on the left: its translation part shifts the camera's axes, its rotation turns about them.
    turned, shifted = (se3.inverse(start) @ T)[:3, :3] - np.eye(3), (se3.inverse(start) @ T)[:3, 3]
    assert bool(np.abs(turned).max() > 1e-5) is (moving == "rotation")
    assert bool(np.abs(shifted).max() > 1e-5) is (moving == "translation")


def test_at_rate_zero_poses_stay_to_the_bit() -> None:
    still = settings(mapping__lr_pose_translation="0", mapping__lr_pose_rotation="0", mapping__iterations="20")
    mapper = mapped(still, {0: np.eye(4), 5: OFF})
    assert mapper.keyframes[1].T_world_camera.tobytes() == (true_pose(5) @ OFF).tobytes()
    assert mapper.keyframes[0].T_world_camera.tobytes() == np.eye(4).tobytes()


def followed(**changes: str) -> tuple[Slam, list[Any]]:
    slam = Slam(settings(mapping__first_iterations="60", mapping__iterations="20", **changes))
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


def test_with_poses_fixed_the_path_is_what_each_step_said() -> None:
    slam, steps = followed(mapping__lr_pose_translation="0", mapping__lr_pose_rotation="0")
    for step, T_world_camera in zip(steps, slam.trajectory().T_world_camera, strict=True):
        np.testing.assert_allclose(T_world_camera, step.T_world_camera, atol=1e-12)
