"""Axes of exports: every convention is a rotation, and a tilted run stands upright in all of them."""

from pathlib import Path

import numpy as np
import pytest

from box_room import seer
from room_run import PATH, WORLD, made_run
from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.outputs import axes as module
from sigmasplat.plugins.outputs.axes import AXES, level_cameras, levelled, transform_to
from sigmasplat.plugins.outputs.run_reader import RunReader

UP_ROW = {"y-up": 1, "z-up": 2}


@pytest.mark.parametrize("axes", AXES)
def test_every_convention_is_a_rotation_about_the_origin(axes: str) -> None:
    T = transform_to(axes, level_cameras(PATH))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0) and not T[:3, 3].any()


def test_a_level_camera_gives_the_axes_of_the_table() -> None:
    right, down, ahead = np.eye(3)
    for axes, x, y, z in (
        ("y-up", right, -down, -ahead), ("z-up", right, ahead, -down), ("y-down", right, down, ahead),
        ("camera", right, down, ahead),
    ):  # fmt: skip
        np.testing.assert_allclose(transform_to(axes)[:3, :3], np.stack([x, y, z]), atol=1e-12)


def test_a_run_of_a_tilted_camera_stands_upright(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera looks 29° down; the room's floor and walls give the vertical direction."""
    monkeypatch.setattr(module, "FieldRenderer", lambda *_: seer(WORLD))
    run = made_run(tmp_path / "run", submaps=True)
    R, said, confirmed = levelled(RunReader(run))
    assert confirmed and "--up left" in said and "is level" in said
    up = WORLD[:3, 2]
    for axes, row in UP_ROW.items():
        np.testing.assert_allclose((transform_to(axes, R)[:3, :3] @ up)[row], 1.0, atol=1e-4)
    np.testing.assert_allclose(transform_to("y-down", R)[:3, :3] @ up, [0.0, -1.0, 0.0], atol=5e-3)
    assert (transform_to("y-up", R)[:3, :3] @ PATH.T_world_camera[0, :3, 2])[2] < 0, "the first camera looks along -z"


def test_cameras_level_a_map_without_surfaces() -> None:
    turned = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -1.0, 2.0]))
    path = Trajectory(PATH.timestamps_s, turned @ PATH.T_world_camera)
    R = level_cameras(path)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert R[2] @ (turned[:3, :3] @ WORLD[:3, 2]) > 0.85 and R[1] @ path.T_world_camera[0, :3, 2] > 0.8
    down = np.eye(4)[None].copy()
    down[0, :3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    assert np.isfinite(level_cameras(Trajectory(np.zeros(1), down))).all()
