"""A camera that is covered and uncovered elsewhere: lost at once, found again, and never placed wrongly in silence."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.io.state import read_state, write_state
from sigmasplat.model import se3
from sigmasplat.model.frame import Frame
from sigmasplat.model.submap import MemoryStore
from sigmasplat.presets import preset
from sigmasplat.slam.slam import Slam
from sigmasplat.slam.state import CLASSES, fixed, restore, state_of
from small_room import frame_at, walk

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

BLACK = -1
SMALL = {
    "input.width": "160", "mapping.first_iterations": "20", "mapping.iterations": "6", "mapping.every": "3",
    "submaps.frames": "5", "final.iterations": "0", "recovery.new_map_after": "3",
}  # fmt: skip
OFF_M = 0.1
"""A believed pose that is off by more than this is a silent failure."""

Order = Sequence[int]


def settings(**changes: str) -> Config:
    names = {name.replace("__", "."): value for name, value in changes.items()}
    return override(preset("sigma"), SMALL | names)


@cache
def seen(i: int) -> Frame:
    """Return a frame of the walk, or a black one."""
    if i != BLACK:
        return frame_at(i)
    return replace(frame_at(0), color=np.zeros((120, 160, 3), np.float32), depth_m=np.zeros((120, 160), np.float32))


def shown(order: Order) -> Iterator[Frame]:
    """Return frames of the walk in another order, with their own times."""
    for n, i in enumerate(order):
        yield replace(seen(i), index=n, timestamp_s=n / 30.0)


def followed(order: Order, config: Config) -> Slam:
    slam = Slam(config)
    for frame in shown(order):
        slam.step(frame)
    return slam


def errors_m(slam: Slam, order: Order) -> NDArray[np.float64]:
    """Return the position error of each frame, in the world; NaN for black frames."""
    T = walk().truth().T_world_camera
    off = slam.trajectory().T_world_camera[:, :3, 3] - (se3.inverse(T[order[0]]) @ T[np.maximum(order, 0)])[:, :3, 3]
    return np.where(np.array(order) == BLACK, np.nan, np.linalg.norm(off, axis=1))


def states(slam: Slam) -> list[str]:
    return [step.state for step in slam.steps]


def contents(slam: Slam) -> dict[str, bytes]:
    """Return every byte of what a run leaves."""
    tensors = {name: tensor.numpy().tobytes() for name, tensor in slam.checkpoint().items()}
    steps = repr([(step.state, step.component, step.tracking) for step in slam.steps]).encode()
    return tensors | {"steps": steps, "map": slam.field.params.numpy().tobytes()}


# ---- uncovered elsewhere: found in a part of the map that is finished

AHEAD, BACK = range(0, 50, 2), range(6, 18, 2)
KIDNAPPED = [*AHEAD, *[BLACK] * 20, *BACK]


@pytest.fixture(scope="module")
def kidnapped() -> Slam:
    return followed(KIDNAPPED, settings())


def test_a_covered_camera_is_lost_at_once_and_found_where_it_is_uncovered(kidnapped: Slam) -> None:
    now = states(kidnapped)
    assert set(now[: len(AHEAD)]) == {"tracked"}
    assert set(now[len(AHEAD) : -len(BACK)]) == {"lost"}
    assert "relocalised" in now[-len(BACK) :][:3] and now[-1] in ("tracked", "relocalised")
    assert kidnapped.believed()[-1] and kidnapped.atlas.components == [0] * len(kidnapped.atlas.components)


def test_no_believed_pose_is_wrong(kidnapped: Slam) -> None:
    off, ahead = errors_m(kidnapped, KIDNAPPED), slice(len(AHEAD))
    assert np.nanmax(off[kidnapped.believed()]) < OFF_M
    undisturbed, all_of_it = (np.sqrt(np.mean(e**2)) for e in (off[ahead], off[kidnapped.believed()]))
    assert all_of_it <= 1.5 * undisturbed + 1e-3


def test_nothing_is_mapped_where_the_camera_is_lost(kidnapped: Slam) -> None:
    assert not any(step.is_keyframe for step in kidnapped.steps if step.lost)


# ---- uncovered where no map is: a new map begins, and joins

JOINING = [*range(10), BLACK, BLACK, *range(2, 6), BLACK, *range(48, 6, -2)]
BEGUN, JOINED = 19, 34


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path]:
    """Return a run, and the folder of its states after each frame."""
    slam, folder = Slam(settings()), tmp_path_factory.mktemp("states")
    for frame in shown(JOINING):
        slam.step(frame)
        write_state(folder / f"{frame.index}.st", state_of(slam), CLASSES, fixed(slam))
    return slam, folder


def test_a_new_map_begins_apart_and_joins_where_the_world_is_recognised(joined: tuple[Slam, Path]) -> None:
    slam = joined[0]
    parts, now = [step.component for step in slam.steps], states(slam)
    begun = parts.index(1)
    ends = len(parts) - parts[::-1].index(1)
    assert now[begun - 2 : begun] == ["lost", "lost"] and set(now[begun:ends]) == {"apart"}
    assert set(parts[ends:]) == {0} and set(now[ends:]) <= {"tracked", "relocalised"} and ends < len(parts)
    assert set(slam.atlas.components) == {0} and slam.components() == []
    assert slam.believed().tolist() == [state != "lost" for state in now], "the frames that were apart are believed"
    assert np.nanmax(errors_m(slam, JOINING)[slam.believed()]) < 0.02


@pytest.mark.parametrize("after", [11, 17, 18, 21, 31, 34], ids=lambda n: f"frame {n}")
def test_a_run_resumes_with_the_same_bytes_while_the_camera_is_lost_or_apart(
    joined: tuple[Slam, Path], after: int
) -> None:
    """Lost with a known place ahead, lost before a new map, apart, one observation before the join, after the join."""
    whole, folder = joined
    state = read_state(folder / f"{after}.st", CLASSES, fixed(whole))
    store = MemoryStore(whole.store.submaps[: state["submaps"]], whole.store.pictures[: state["submaps"]])
    slam = Slam(settings(), store)
    slam.prepare(whole.view.camera)
    restore(slam, read_state(folder / f"{after}.st", CLASSES, fixed(slam)))
    for frame in list(shown(JOINING))[after + 1 :]:
        slam.step(frame)
    assert contents(slam) == contents(whole)
