"""Something large moves in front of the camera: it is not mapped, and the camera is not lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import MemoryStore
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from small_room import SMALL, frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES, ENTERS, LEAVES, RESUMED = 30, 6, 24, 15
RADIUS_PX, NEAREST_M = 42.0, 0.5
CONFIG = override(preset("sigma"), SMALL | {"mapping.every": "3", "submaps.frames": "12", "final.iterations": "0"})


def with_ball(frame: Frame, i: int) -> Frame:
    """Return a frame with a ball of one colour that crosses the image from the left; it covers up to a third."""
    if not ENTERS <= i < LEAVES:
        return frame
    h, w = frame.depth_m.shape
    column = np.interp(i, [ENTERS, LEAVES], [-RADIUS_PX, w + RADIUS_PX])
    v, u = np.mgrid[:h, :w]
    off = ((u - column) ** 2 + (v - h / 2) ** 2) / RADIUS_PX**2
    ball, color, depth_m = off < 1.0, frame.color.copy(), frame.depth_m.copy()
    color[ball], depth_m[ball] = (1.0, 0.0, 1.0), NEAREST_M + 0.1 * off[ball]
    return replace(frame, color=color, depth_m=depth_m)


def step(slam: Slam, i: int) -> None:
    slam.step(with_ball(frame_at(i), i))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path]:
    """Return a run past the ball, and the file of its state while the ball is in view."""
    slam, path = Slam(CONFIG), tmp_path_factory.mktemp("state") / "state"
    for i in range(FRAMES):
        if i == RESUMED:
            write_state(path, state_of(slam), CLASSES, fixed(slam))
        step(slam, i)
    return slam, path


def positions_m(slam: Slam) -> NDArray[np.float64]:
    return slam.trajectory().T_world_camera[:, :3, 3]


def test_no_frame_is_lost_and_the_path_is_right(run: tuple[Slam, Path]) -> None:
    slam, T = run[0], walk().truth().T_world_camera
    off_m = np.linalg.norm(positions_m(slam) - (se3.inverse(T[0]) @ T[:FRAMES])[:, :3, 3], axis=1)
    assert {s.state for s in slam.steps} == {"tracked"}
    assert off_m.max() < 0.03


def test_keyframes_are_mapped_while_the_object_is_in_view(run: tuple[Slam, Path]) -> None:
    assert sum(s.is_keyframe for s in run[0].steps[ENTERS + 2 : LEAVES - 2]) >= 3


def test_the_map_has_no_splats_of_the_object(run: tuple[Slam, Path]) -> None:
    """In the walk, no surface of the room is as near to the camera as the ball, and none has its colour."""
    red, green, blue = run[0].field.colors.T
    assert float(((red - green > 0.4) & (blue - green > 0.4)).float().mean()) < 0.002


def test_a_run_resumed_while_the_object_is_in_view_is_the_same(run: tuple[Slam, Path]) -> None:
    whole, path = run
    store = MemoryStore()
    slam = Slam(CONFIG, store)
    slam.prepare(frame_at(0).camera)
    state = read_state(path, CLASSES, fixed(slam))
    store.submaps += whole.store.submaps[: state["submaps"]]
    store.pictures += whole.store.pictures[: state["submaps"]]
    restore(slam, state)
    for i in range(RESUMED, FRAMES):
        step(slam, i)
    np.testing.assert_array_equal(positions_m(slam), positions_m(whole))
