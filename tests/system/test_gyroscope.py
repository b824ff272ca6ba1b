"""A gyroscope in the whole system: it holds tracking in quick turns and in the dark, and a wrong one does no harm."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources.room.render import build_scene, render_scene
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from small_room import SMALL, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

YAW_DEG = (0, 0, 0, 25, 0, -25, 5, 30, -10, 0)
"""Direction of a camera that stays in its place and is shaken left and right."""
BLIND = SMALL | {"tracking.features": "false", "recovery.relocalise": "false", "final.iterations": "0"}
"""Settings with which only a guess from the motion can help."""


def rotation(degrees: float) -> NDArray[np.float64]:
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


@cache
def shaken(i: int) -> Frame:
    T_world_camera = walk().truth().T_world_camera[0].copy()
    T_world_camera[:3, :3] = T_world_camera[:3, :3] @ rotation(YAW_DEG[i])
    color, depth_m = render_scene(build_scene(1, 0), walk().camera, T_world_camera)
    return Frame(i, i / 30, color, depth_m, walk().camera)


def measured(i: int) -> Frame:
    """Return a frame with the rotation that a gyroscope measures, about 1° off."""
    error = Rotation.from_rotvec(np.deg2rad(np.random.default_rng(i).normal(0, 0.6, 3))).as_matrix()
    return replace(shaken(i), R_inertial_camera=rotation(90.0) @ rotation(YAW_DEG[i]) @ error)


def followed(frames: list[Frame]) -> Slam:
    slam = Slam(override(preset("sigma"), BLIND))
    for frame in frames:
        slam.step(frame)
    return slam


def errors_deg(slam: Slam) -> NDArray[np.float64]:
    R = slam.trajectory().T_world_camera[:, :3, :3]
    return np.rad2deg([se3.rotation_angle(rotation(yaw).T @ r) for yaw, r in zip(YAW_DEG, R, strict=True)])


FRAMES = range(len(YAW_DEG))


@pytest.fixture(scope="module")
def with_it() -> Slam:
    return followed([measured(i) for i in FRAMES])


def test_quick_turns_are_tracked_with_a_gyroscope_and_lost_without(with_it: Slam) -> None:
    assert not any(step.lost for step in with_it.steps) and errors_deg(with_it).max() < 0.5
    assert np.linalg.norm(with_it.trajectory().T_world_camera[:, :3, 3], axis=1).max() < 0.02
    without = followed([shaken(i) for i in FRAMES])
    assert any(step.lost for step in without.steps) and errors_deg(without).max() > 5


def test_a_covered_camera_that_turns_is_tracked_again_where_it_is_uncovered() -> None:
    frames = [measured(i) for i in FRAMES]
    black = np.zeros_like(frames[0].color), np.zeros_like(frames[0].depth_m)
    for i in (3, 4, 5, 6):
        frames[i] = replace(frames[i], color=black[0], depth_m=black[1])
    slam = followed(frames)
    assert [step.index for step in slam.steps if step.lost] == [3, 4, 5, 6]
    off = errors_deg(slam)
    assert off[7:].max() < 0.5 and off[3:7].max() < 5, "lost frames have the measured rotation"


def test_a_wrong_gyroscope_does_not_lose_a_camera_that_is_held_still() -> None:
    """Its rotation is only a guess: the last pose is tried too, and the images decide."""
    frames = [replace(measured(i), color=shaken(0).color, depth_m=shaken(0).depth_m) for i in FRAMES]
    slam = followed(frames)
    assert not any(step.lost for step in slam.steps)
    assert np.rad2deg([se3.rotation_angle(R) for R in slam.trajectory().T_world_camera[:, :3, :3]]).max() < 0.5


def test_a_run_resumes_between_two_measured_frames_with_the_same_bytes(with_it: Slam, tmp_path: Path) -> None:
    first = followed([measured(i) for i in FRAMES[:5]])
    write_state(tmp_path / "state", state_of(first), CLASSES, fixed(first))
    resumed = Slam(first.config)
    resumed.prepare(first.view.camera)
    restore(resumed, read_state(tmp_path / "state", CLASSES, fixed(resumed)))
    for i in FRAMES[5:]:
        resumed.step(measured(i))
    assert resumed.trajectory().T_world_camera.tobytes() == with_it.trajectory().T_world_camera.tobytes()
    assert resumed.field.params.numpy().tobytes() == with_it.field.params.numpy().tobytes()
