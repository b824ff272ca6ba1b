"""What grows with the length of a run: columns in RAM and on disk, what is kept in them, and memory per frame."""

import errno
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.poses import Column, KeyframePoses, Place, Poses
from sigmasplat.data.relative_pose import UNKNOWN_HOP, Edges, Kind, RelativePose
from sigmasplat.data.submap import MemoryStore, Submap
from sigmasplat.errors import RunError
from sigmasplat.files.json_files import write_json
from sigmasplat.graph.candidates import DescribedSubmaps, SubmapDescriptor
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.graph.pose_graph import LoopVerdict
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.slam.results import Step
from sigmasplat.system.slam import Slam

MOST_BYTES = 100
"""Most bytes of RAM per frame of a long run; with lists of objects it was 1200."""
PER_SUBMAP, KEYFRAMES, LOOPS = 15, 4, 3


def motion(seed: int) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(0.0, 0.4, 6))


# ---- columns


def filled(folder: Path | None, count: int = 30_000) -> Column:
    column = Column.of(np.float64, 2, 3)
    column.folder = folder
    for i in range(count):
        column.append(np.full((2, 3), i))
    return column


def test_a_long_column_has_the_same_values_on_disk_and_leaves_no_name_there(tmp_path: Path) -> None:
    ram, disk = filled(None), filled(tmp_path)
    assert np.array_equal(ram.used, disk.used) and not list(tmp_path.iterdir())
    early = disk.used[:3]
    disk.release()
    disk.extend(np.ones((200_000, 2, 3)))
    disk.used[1] = 7.0
    disk.release()
    assert len(disk) == 230_000 and (disk.used[-1] == 1.0).all() and disk.used[29_999, 0, 0] == 29_999
    assert early[2, 0, 0] == 2.0 and (early[1] == 7.0).all(), "an array that was read before shows the same memory"
    assert np.array_equal(disk.first(2).used, disk.used[:2])


def test_a_long_column_on_disk_takes_no_ram(tmp_path: Path) -> None:
    tracemalloc.start()
    try:
        column, before = filled(tmp_path, 10_000), tracemalloc.get_traced_memory()[0]
        column.extend(np.zeros((100_000, 2, 3)))
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 10_000 and len(column) == 110_000


def test_a_column_stays_in_ram_if_the_disk_has_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    column = filled(tmp_path)

    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    column.extend(np.ones((100_000, 2, 3)))
    assert np.array_equal(column.used[:30_000], filled(None).used) and (column.used[30_000:] == 1.0).all()
    assert np.array_equal(filled(tmp_path).used, filled(None).used)


def test_a_folder_that_does_not_exist_yet_or_cannot_be_written_is_no_problem(tmp_path: Path) -> None:
    assert len(filled(tmp_path / "run" / "submaps")) == 30_000 and not list(tmp_path.iterdir())
    assert len(filled(Path("/proc/sigmasplat"))) == 30_000


@pytest.mark.parametrize("on_disk", [False, True], ids=["in RAM", "on disk"])
def test_a_saved_column_is_read_back(tmp_path: Path, on_disk: bool) -> None:
    (tmp_path / "disk").mkdir()
    for count in (0, 3, 30_000):
        column = filled(tmp_path / "disk" if on_disk else None, count)
        write_state(tmp_path / "state", {"column": column}, [Column], {})
        read = read_state(tmp_path / "state", [Column], {})["column"]
        assert np.array_equal(read.used, column.used) and read.used.shape == column.used.shape
        read.append(np.full((2, 3), 5.0))
        assert (read.used[-1] == 5.0).all() and len(read) == count + 1


# ---- what is kept in columns


def test_poses_are_read_as_they_were_set_and_what_was_read_stays() -> None:
    poses, T = Poses(), [motion(i) for i in range(3)]
    for pose in T[:2]:
        poses.append(pose)
    before, copied = poses[1], poses.copied()
    poses[-1] = T[2]
    assert np.array_equal(poses[1], T[2]) and np.array_equal(before, T[1]) and np.array_equal(copied[1], T[1])
    assert np.array_equal(np.array(poses), [T[0], T[2]]) and len(list(poses)) == 2
    with pytest.raises(IndexError):
        poses[2] = T[0]


def test_keyframes_of_the_last_submap_may_change_and_the_others_are_final() -> None:
    poses, T = KeyframePoses(), [motion(i) for i in range(6)]
    assert len(poses) == 0 and poses.stacked().shape == (0, 4, 4) and poses.counts.tolist() == []
    for known in (T[:2], [], T[2:5]):
        poses.begin(known)
    before = poses.copied()
    poses[-1].append(T[5])  # type: ignore[attr-defined]
    assert poses.counts.tolist() == [2, 0, 4] and poses.total == 6 and [len(p) for p in poses] == [2, 0, 4]
    assert np.array_equal(poses.stacked(), T) and np.array_equal(poses[0], T[:2]) and np.array_equal(poses[2][3], T[5])
    assert before.counts.tolist() == [2, 0, 3]
    poses.newest = [T[0]]
    assert np.array_equal(poses[2], T[:1]) and [len(p) for p in poses[:2]] == [2, 0]


def loop(i: int, accepted: bool = True, reason: str = "accepted") -> Loop:
    return Loop(i, i // 2, 3 * i, i, 0.9, 0.95, accepted, reason, 0.01 * i, 0.5, 2, 0.1, 3.0, motion(i))


def test_loops_are_read_as_they_were_tried_with_the_latest_verdict() -> None:
    loops, known = Loops(), [loop(i, i % 3 > 0, "accepted" if i % 3 else f"overlap 0.{i}") for i in range(9)]
    for each in known:
        loops.append(each)
    assert [str(each.record()) for each in loops] == [str(each.record()) for each in known]
    copied = loops.copied()
    loops.judge(1, LoopVerdict(0.1, 40.0, accepted=False))
    loops.judge(2, LoopVerdict(0.9, 2.0, accepted=True))
    loops.append(loop(9))
    assert (loops[1].accepted, loops[1].reason) == (False, "the pose graph disagrees (χ² 40)")
    assert (loops[2].chi2, loops[2].weight, loops[2].accepted) == (2.0, 0.9, True)
    assert [loops.is_rejected(i) for i in (0, 1, 2)] == [False, True, False], "loop 0 is no edge of the pose graph"
    assert len(copied) == 9 and copied[1].accepted and np.isnan(copied[2].chi2), "a copy keeps its verdicts"
    assert loops.accepted.tolist() == [False, False, True, False, True, True, False, True, True, True]


def test_edges_are_read_as_they_were_added() -> None:
    edges, information = Edges(), np.diag(np.arange(1.0, 7.0))
    kinds: list[Kind] = ["loop", "odometry", "loop", "join"]
    known = [RelativePose(i, i + 1, motion(i), i * information, kind) for i, kind in enumerate(kinds, 1)]
    for row, edge in enumerate(known):
        edges.append(edge, row)
    for found, edge in zip(edges, known, strict=True):
        assert (found.a, found.b, found.kind) == (edge.a, edge.b, edge.kind)
        assert np.array_equal(found.T_a_b, edge.T_a_b) and np.array_equal(found.information, edge.information)
    assert edges.loop_rows(range(4)).tolist() == [0, -1, 2, -3] and edges.loop_rows([]).tolist() == []
    some = edges.taken(np.array([False, True, True, False]))
    assert some.ends.tolist() == [[2, 3], [3, 4]] and some.is_loop.tolist() == [False, True]
    assert np.array_equal(some.T_a_b, [edge.T_a_b for edge in known[1:3]])
    assert np.array_equal(some.information, [edge.information for edge in known[1:3]])
    assert Edges().T_a_b.shape == (0, 4, 4)


def test_described_submaps_are_read_as_they_were_added() -> None:
    rng = np.random.default_rng(0)
    counts = (0, 3, 0, 2)
    known = [SubmapDescriptor(5 * i, rng.random((n, 4), np.float32), 1.0 + i) for i, n in enumerate(counts)]
    found = DescribedSubmaps()
    for each in known:
        found.append(each)
    assert found.counts.tolist() == [0, 3, 0, 2] and found.numbers.tolist() == [0, 5, 10, 15]
    assert found.opacity_ratio.tolist() == [1, 2, 3, 4]
    for each, before in zip(found, known, strict=True):
        assert (each.index, each.opacity_ratio) == (before.index, before.opacity_ratio)
        assert np.array_equal(each.descriptors.ravel(), before.descriptors.ravel())
    assert not DescribedSubmaps().counts.size


def test_an_iterator_is_written_as_the_list_is(tmp_path: Path) -> None:
    for items in ([], [{"a": [1, 2.5, None]}], [{"b": float("nan")}, 3, "é"]):
        write_json(tmp_path / "list.json", items)
        write_json(tmp_path / "iterator.json", iter(items))
        assert (tmp_path / "list.json").read_bytes() == (tmp_path / "iterator.json").read_bytes()
    with pytest.raises(RunError, match="cannot write"):
        write_json(tmp_path / "missing" / "x.json", iter([1]))


# ---- memory per frame


def follow(slam: Slam, frames: range) -> None:
    """Add what SLAM keeps of frames: a submap every 15 frames, four keyframes and three loops in each."""
    T, atlas, closer = motion(1), slam.atlas, slam.closer
    field = GaussianField.from_values(torch.zeros(3, 3), torch.ones(3), torch.zeros(3, 3))
    described = [np.full(192, 192**-0.5, np.float32)] * KEYFRAMES
    for i in frames:
        submap, k = i // PER_SUBMAP, i % PER_SUBMAP
        if k == 0:
            if submap:
                finished = Submap(
                    submap - 1, field, tuple(range(KEYFRAMES)), np.array([T] * KEYFRAMES), Camera(4, 3, 4, 4, 2, 1)
                )
                closer.add_finished(finished, described, T)
                for _ in range(LOOPS):
                    closer.edges.append(RelativePose(submap - 1, submap, T, np.eye(6)))
                    closer.loops.append(loop(i))
            atlas.begin_submap(T if submap else None)
        if k % 5 == 0 or k == PER_SUBMAP - 1:
            atlas.set_keyframes([T.copy() for _ in range(1 + len(atlas.keyframe_poses[-1]))], UNKNOWN_HOP)
            slam.keyframe_indices.append(i)
            slam.confidence.placed(len(slam.confidence.doubts), 0.0, [])
        atlas.places.append(Place(submap, len(atlas.keyframe_poses[-1]) - 1, T))
        slam.steps.append(Step(i, i / 30, T.copy(), k % 5 == 0, False, {}, 1000, submap))
        slam.steps.whole.clear()


def bytes_per_frame(slam: Slam) -> float:
    tracemalloc.start()
    try:
        follow(slam, range(9000))
        before = tracemalloc.get_traced_memory()[0]
        follow(slam, range(9000, 13_500))
        return (tracemalloc.get_traced_memory()[0] - before) / 4500
    finally:
        tracemalloc.stop()


def test_ram_hardly_grows_with_the_number_of_frames_if_submaps_are_on_disk(tmp_path: Path) -> None:
    slam = Slam("sigma", DiskStore(tmp_path / "submaps"))
    found = bytes_per_frame(slam)
    assert found < MOST_BYTES, found
    assert not list(tmp_path.iterdir()), "nothing has a name on the disk"
    in_memory = Slam("sigma", MemoryStore())
    follow(in_memory, range(13_500))
    assert np.array_equal(slam.atlas.T_world_camera(), in_memory.atlas.T_world_camera())
    assert np.array_equal(slam.steps.timestamps_s, in_memory.steps.timestamps_s)
    assert [str(each.record()) for each in slam.loops[-9:]] == [str(each.record()) for each in in_memory.loops[-9:]]
