"""A camera that is covered and uncovered elsewhere: lost at once, found again, and never placed wrongly in silence."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import chdtri

from constants import changed
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import MemoryStore
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.source import Source
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run.session import Session, new_folder
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from small_room import frame_at, walk

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

BLACK = -1
SMALL = {
    "input.width": "160", "mapping.first_iterations": "20", "mapping.iterations": "6", "mapping.every": "3",
    "submaps.frames": "5", "final.iterations": "0",
}  # fmt: skip
OFF_M = 0.1
"""A valid pose that is off by more than this is a silent failure."""

Order = Sequence[int]


def settings(**changes: str) -> Config:
    names = {name.replace("__", "."): value for name, value in changes.items()}
    config = override(preset("sigma"), SMALL | names)
    return replace(config, recovery=changed(config.recovery, new_map_after=3))


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


Recorded = tuple[Slam, Path]
"""A run, and the folder of its states after each frame."""


def recorded(order: Order, folder: Path) -> Recorded:
    slam = Slam(settings())
    for frame in shown(order):
        slam.step(frame)
        write_state(folder / f"{frame.index}.st", state_of(slam), CLASSES, fixed(slam))
    return slam, folder


def resumed(run: Recorded, after: int, order: Order) -> Slam:
    """Return a run that was stopped after a frame, resumed from its state and its submaps, and went on to the end."""
    whole, folder = run
    assert isinstance(whole.store, MemoryStore)
    store = MemoryStore()
    slam = Slam(settings(), store)
    slam.prepare(whole.view.camera)
    state = read_state(folder / f"{after}.st", CLASSES, fixed(slam))
    store.submaps += whole.store.submaps[: state["submaps"]]
    store.pictures += whole.store.pictures[: state["submaps"]]
    restore(slam, state)
    for frame in list(shown(order))[after + 1 :]:
        slam.step(frame)
    return slam


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
def kidnapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path]:
    return recorded(KIDNAPPED, tmp_path_factory.mktemp("kidnapped"))


def test_a_covered_camera_is_lost_at_once_and_found_where_it_is_uncovered(kidnapped: Recorded) -> None:
    slam, now = kidnapped[0], states(kidnapped[0])
    assert set(now[: len(AHEAD)]) == {"tracked"}
    assert set(now[len(AHEAD) : -len(BACK)]) == {"lost"}
    assert "relocalised" in now[-len(BACK) :][:3] and now[-1] in ("tracked", "relocalised")
    assert slam.valid()[-1] and set(slam.atlas.components) == {0}


def test_no_valid_pose_is_wrong(kidnapped: Recorded) -> None:
    slam = kidnapped[0]
    off, ahead = errors_m(slam, KIDNAPPED), slice(len(AHEAD))
    assert np.nanmax(off[slam.valid()]) < OFF_M
    undisturbed, all_of_it = (np.sqrt(np.mean(e**2)) for e in (off[ahead], off[slam.valid()]))
    assert all_of_it <= 1.5 * undisturbed + 1e-3


def test_nothing_is_mapped_where_the_camera_is_lost(kidnapped: Recorded) -> None:
    assert not any(step.is_keyframe for step in kidnapped[0].steps if step.lost)


@pytest.mark.slow
def test_the_same_run_has_the_same_bytes_on_two_threads(kidnapped: Recorded) -> None:
    before = _core.threads(), torch.get_num_threads()
    _core.set_threads(2)
    torch.set_num_threads(2)
    try:
        assert contents(followed(KIDNAPPED, settings())) == contents(kidnapped[0])
    finally:
        _core.set_threads(before[0])
        torch.set_num_threads(before[1])


def test_a_run_resumes_with_the_same_bytes_after_a_relocalisation(kidnapped: Recorded) -> None:
    whole, found = kidnapped[0], states(kidnapped[0]).index("relocalised")
    slam = resumed(kidnapped, found, KIDNAPPED)
    assert contents(slam) == contents(whole)
    assert dataclasses.asdict(slam.tracker.statistics) == dataclasses.asdict(whole.tracker.statistics)
    assert slam.relocaliser.indexed == whole.relocaliser.indexed


def test_a_hop_after_a_relocalisation_has_the_error_of_the_hops_since_the_place() -> None:
    """The first keyframe after it is aligned to the one where the camera was found, not to the newest one."""
    order = [*range(0, 60, 2), BLACK, BLACK, *range(4, 14, 2)]
    slam = followed(order, settings(submaps__frames="0", submaps__distance_m="0", submaps__uncertainty_m="0"))
    numbers, T = slam.keyframe_indices, walk().truth().T_world_camera
    row = next(row for row, number in enumerate(numbers) if number > states(slam).index("relocalised"))
    hop, (before, now) = slam.atlas.hops[row], (T[order[numbers[k]]] for k in (row - 1, row))
    off = se3.log(se3.inverse(now) @ before @ se3.inverse(hop.T_a_b))
    assert hop.total_covariance is not None
    assert off @ np.linalg.solve(hop.total_covariance, off) < chdtri(6, 1e-3)


@pytest.mark.slow
def test_nothing_still_is_taken_for_moving_after_a_relocalisation() -> None:
    slam = followed([*AHEAD, BLACK, BLACK, *BACK[:4]], settings(moving__find="true"))
    assert "relocalised" in states(slam)
    assert [step.tracking.get("moving", 0.0) for step in slam.steps] == [0.0] * len(slam.steps)


# ---- uncovered where no map is: a new map begins, and joins

JOINING = [*range(10), BLACK, BLACK, *range(2, 6), BLACK, *range(48, 6, -2)]


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path]:
    return recorded(JOINING, tmp_path_factory.mktemp("joined"))


def test_a_new_map_begins_apart_and_joins_where_the_world_is_recognised(joined: Recorded) -> None:
    slam = joined[0]
    parts, now = [step.component for step in slam.steps], states(slam)
    begun = parts.index(1)
    ends = len(parts) - parts[::-1].index(1)
    assert now[begun - 2 : begun] == ["lost", "lost"] and set(now[begun:ends]) == {"apart"}
    assert set(parts[ends:]) == {0} and set(now[ends:]) <= {"tracked", "relocalised"} and ends < len(parts)
    assert set(slam.atlas.components) == {0} and slam.components() == []
    assert slam.valid().tolist() == [state != "lost" for state in now], "the frames that were apart are valid"
    assert np.nanmax(errors_m(slam, JOINING)[slam.valid()]) < 0.02


@pytest.mark.parametrize(
    "after",
    [pytest.param(11, marks=pytest.mark.slow), pytest.param(18, marks=pytest.mark.slow), 30],
    ids=lambda n: f"frame {n}",
)
def test_a_run_resumes_with_the_same_bytes_while_the_camera_is_lost_or_apart(joined: Recorded, after: int) -> None:
    """Lost with a known place ahead; lost before a new map begins; apart, with one observation before the join."""
    now, parts = states(joined[0]), [step.component for step in joined[0].steps]
    assert (now[after], parts[after]) == {11: ("lost", 0), 18: ("lost", 0), 30: ("apart", 1)}[after]
    assert contents(resumed(joined, after, JOINING)) == contents(joined[0])


# ---- another room: never joined


class TwoRooms(Source):
    """A few frames of a room, black ones, and frames of the room's mirror image: another place that looks alike."""

    order = (*range(0, 16, 2), BLACK, *range(60, 80, 2))

    def __init__(self) -> None:
        super().__init__("rooms", walk().camera)

    def __len__(self) -> int:
        return len(self.order)

    def frame(self, i: int) -> Frame:
        frame = replace(seen(self.order[i]), index=i, timestamp_s=i / 30.0)
        if self.order[i] < 60:
            return frame
        color, depth_m = (np.ascontiguousarray(image[:, ::-1]) for image in (frame.color, frame.depth_m))
        return replace(frame, color=color, depth_m=depth_m)

    def truth(self) -> Trajectory | None:
        return None


def test_another_room_is_kept_apart_in_all_files(tmp_path: Path) -> None:
    source, config = TwoRooms(), settings(final__iterations="3")
    run = new_folder(tmp_path / "run", config, source)
    slam = Slam(config, run.submaps)
    outcome = Session(slam, source, run).execute()
    log, first = run.read_log(), 8
    assert {line["component"] for line in log[:first]} == {0} and log[-1]["state"] == "apart"
    apart = [line["index"] for line in log if line["state"] == "apart"]
    assert len(apart) >= 5 and min(apart) > first and outcome.apart == (len(apart),)
    path = run.read_trajectory()
    assert path.timestamps_s.tolist() == pytest.approx([i / 30.0 for i in range(first)], abs=1e-9)
    of_world = [s for s, component in enumerate(slam.atlas.components) if component == 0]
    one_room = followed([source.order[i] for i in range(first)], config)
    assert len(of_world) < len(slam.atlas.components)
    points, alone = run.read_map().means, one_room.field.means
    assert len(points) <= sum(len(run.submaps.load(s).field) for s in of_world)
    for side in (points.amin(0) - alone.amin(0), points.amax(0) - alone.amax(0)):
        assert side.abs().max() < 0.3, "the map of the world ends where the first room was seen"
    (part,) = slam.components()
    assert len(part.trajectory) == len(apart) and len(part.field) > 0
    files = run.path / "components" / str(part.number)
    assert {file.name for file in files.iterdir()} == {"trajectory.txt", "map.ply"}
