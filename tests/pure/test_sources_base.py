"""Read-ahead, subsets, association by time."""

import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from paper_settings import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.input.lists import associate
from sigmasplat.input.source import Source, Subset, read_ahead


class Counting(Source):
    """Ten frames whose colour is their index; frames in `broken` cannot be read."""

    def __init__(self, broken: tuple[int, ...] = (), strict: bool = False) -> None:
        super().__init__("counting", Camera(2, 2, 1.0, 1.0, 0.5, 0.5), strict)
        self.broken = broken

    def __len__(self) -> int:
        return 10

    def frame(self, i: int) -> Frame:
        if self._checked_index(i) in self.broken:
            raise SourceError(f"{i}.png: unreadable image")
        return Frame(i, i / 10, np.full((2, 2, 3), i / 10, np.float32), np.ones((2, 2), np.float32), self.camera)

    def truth(self) -> Trajectory | None:
        return None


def reading_threads() -> int:
    return sum(thread.name.startswith("read-ahead") for thread in threading.enumerate())


def test_read_ahead_keeps_order_and_ends_its_thread():
    assert list(read_ahead(range(50), 4)) == list(range(50))
    assert reading_threads() == 0


def test_read_ahead_raises_the_producers_error_after_the_earlier_items():
    def items():
        yield from range(3)
        raise ValueError("third")

    seen = []
    with pytest.raises(ValueError, match="third"):
        for item in read_ahead(items()):
            seen.append(item)
    assert seen == [0, 1, 2]
    assert reading_threads() == 0


def test_read_ahead_stops_when_the_consumer_stops():
    made = []

    def items():
        for i in range(1000):
            made.append(i)
            yield i

    for item in read_ahead(items(), 4):
        if item == 5:
            break
    time.sleep(0.02)
    assert reading_threads() == 0
    assert len(made) <= 5 + 1 + 4 + 3


def test_read_ahead_works_ahead_while_the_consumer_is_busy():
    made = threading.Semaphore(0)

    def items():
        for i in range(10):
            made.release()
            yield i

    stream = read_ahead(items(), 4)
    next(stream)
    assert all(made.acquire(timeout=5) for _ in range(5)), "four more items are computed ahead"
    stream.close()


def test_an_unreadable_frame_is_skipped_once_with_its_reason():
    source = Counting(broken=(2, 7))
    for _ in range(2):
        assert [f.index for f in source] == [0, 1, 3, 4, 5, 6, 8, 9]
    assert source.skipped == ["2.png: unreadable image", "7.png: unreadable image"]


def test_strict_raises_at_the_unreadable_frame():
    seen = []
    with pytest.raises(SourceError, match=r"^2\.png"):
        for frame in Counting(broken=(2,), strict=True):
            seen.append(frame.index)
    assert seen == [0, 1]


def test_a_source_without_a_readable_frame_is_an_error():
    with pytest.raises(SourceError, match="none of 10 frames"):
        list(Counting(broken=tuple(range(10))))


def test_subset_strides_limits_and_renumbers():
    part = Subset(Counting(), InputConfig(stride=3, limit=3))
    frames = list(part)
    assert [f.index for f in frames] == [0, 1, 2]
    assert [f.timestamp_s for f in frames] == [0.0, 0.3, 0.6]
    with pytest.raises(IndexError):
        part.frame(3)


def test_subset_selects_a_time_span_before_the_stride():
    part = Subset(Counting(), InputConfig(start_s=0.15, end_s=0.75, stride=2))
    assert [f.timestamp_s for f in part] == [0.2, 0.4, 0.6]
    assert part.timestamp_s(1) == 0.4
    assert len(Subset(Counting(), InputConfig(start_s=0.5))) == 5
    with pytest.raises(SourceError, match="no frame between"):
        Subset(Counting(), InputConfig(start_s=3.0))
    with pytest.raises(ConfigError, match=r"must be after input\.start_s"):
        InputConfig(start_s=3.0, end_s=2.0)


def test_association_of_known_lists():
    color = np.array([0.0, 0.033, 0.066, 5.0])
    depth = np.array([0.070, 0.010, 0.035, 0.001])  # unsorted
    assert associate(color, depth, 0.02).tolist() == [[0, 3], [1, 2], [2, 0]]


def test_association_pairs_the_closest_first():
    # 0.012 is nearest to 0.010 for both first entries, but belongs to the second one, which is nearer.
    assert associate(np.array([0.0, 0.013]), np.array([0.012]), 0.02).tolist() == [[1, 0]]


times = st.lists(st.floats(0, 1, allow_nan=False), max_size=25).map(lambda v: np.array(v, float))


@settings(max_examples=80, deadline=None)
@given(times, times)
def test_association_equals_greedy_search_over_all_pairs(first, second):
    """Oracle: sort the full N×M table of differences and choose greedily."""
    table = sorted((abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) < 0.05)
    used_i, used_j, expected = set(), set(), set()
    for _, i, j in table:
        if i not in used_i and j not in used_j:
            used_i.add(i)
            used_j.add(j)
            expected.add((i, j))
    found = associate(first, second, 0.05)
    assert {(int(i), int(j)) for i, j in found} == expected
    assert (np.diff(first[found[:, 0]]) >= 0).all()
