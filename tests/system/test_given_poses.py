"""Known poses in the whole system: they are used as they are, whatever tracking would have found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.scale import for_scene
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.realtime.system import RealTime
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from small_room import SMALL, frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

WORLD = se3.exp(np.array([2.0, 1.0, -3.0, 0.5, 1.2, -0.4]))
NUMBERS = (0, 1, 2, 3, 4, 5, 6, 60, 61, 62, 120, 121)
"""Leaps of 60 frames, a third of the way round the room: no image shows what the one before shows."""


def config(name: str, **more: str) -> Config:
    """Settings that cut submaps after three frames."""
    given = {"input.poses": "poses.txt", "submaps.frames": "3", "final.iterations": "5", **SMALL, **more}
    return for_scene(override(preset(name), given), 1.0, None)


def posed(i: int) -> Frame:
    truth = walk().truth()
    assert truth is not None
    return replace(frame_at(NUMBERS[i]), index=i, T_given_camera=WORLD @ truth.T_world_camera[NUMBERS[i]])


def expected() -> np.ndarray:
    truth = walk().truth()
    assert truth is not None
    return se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[list(NUMBERS)]


@pytest.mark.parametrize(
    "name", ["sigma", *(pytest.param(name, marks=pytest.mark.slow) for name in ("varsplat-fast", "cgslam-fast"))]
)
def test_the_path_is_the_given_one_also_where_nothing_can_be_tracked(name: str) -> None:
    slam = Slam(config(name, **{"tracking.features": "false", "mapping.first_iterations": "20"}))
    steps = [slam.step(posed(i)) for i in range(len(NUMBERS))]
    slam.finish()
    assert not any(step.lost for step in steps) and {step.component for step in steps} == {0}
    np.testing.assert_allclose(slam.trajectory().T_world_camera, expected(), atol=1e-6)
    assert steps[-1].submap >= 2 and len(slam.field) > 100
    keyframes = [step.is_keyframe for step in steps]
    assert keyframes[7] and keyframes[10] and not all(keyframes), "leaps make keyframes"
    assert all(np.isfinite(step.p_off) for step in steps)


def test_a_frame_without_a_pose_is_tracked_between_given_ones() -> None:
    slam = Slam(config("sigma"))
    for i in range(7):
        frame = posed(i)
        slam.step(replace(frame, T_given_camera=None) if i in (3, 4) else frame)
    off_m = np.linalg.norm((slam.trajectory().T_world_camera - expected()[:7])[:, :3, 3], axis=1)
    assert (off_m[:3] < 1e-6).all() and 1e-6 < off_m[3:].max() < 5e-3


def test_images_that_contradict_a_pose_raise_the_probability_that_it_is_off() -> None:
    slam = Slam(config("sigma"))
    aside = se3.exp(np.array([0.15, 0, 0, 0, 0, 0.0]))
    right = [slam.step(posed(i)).p_off for i in range(6)]
    wrong = replace(posed(6), T_given_camera=posed(6).T_given_camera @ aside)
    assert slam.step(wrong).p_off > 0.5 > 5 * max(right)


def test_in_real_time_the_path_is_the_given_one_too() -> None:
    system = RealTime(Slam(config("sigma")))
    for i in range(len(NUMBERS)):
        system.step(posed(i))
    system.finish()
    np.testing.assert_allclose(system.slam.trajectory().T_world_camera, expected(), atol=1e-6)


def test_a_resumed_run_continues_with_the_given_motion(tmp_path: Path) -> None:
    whole = Slam(config("sigma"))
    for i in range(5):
        whole.step(posed(i))
    write_state(tmp_path / "state", state_of(whole), CLASSES, fixed(whole))
    again = Slam(config("sigma"), whole.store)
    again.prepare(whole.view.camera)
    restore(again, read_state(tmp_path / "state", CLASSES, fixed(again)))
    again.step(posed(5))
    np.testing.assert_allclose(again.trajectory().T_world_camera, expected()[:6], atol=1e-6)
