"""Frames that do not wait for the consumer: the newest ones stay, the others are dropped and counted."""

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources.live import Arrivals

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
FRAME = Frame(0, 0.0, np.zeros((3, 4, 3), np.float32), np.ones((3, 4), np.float32), CAMERA)


class Clip(Source):
    """Six frames, ten per second; one of them may be unreadable."""

    def __init__(self, damaged: int = -1, live: bool = False) -> None:
        super().__init__("clip", CAMERA, strict=True)
        self.damaged, self.live = damaged, live

    def __len__(self) -> int:
        return 6

    def frame(self, i: int) -> Frame:
        if i == self.damaged:
            raise SourceError(f"frame {i} is damaged")
        return replace(FRAME, index=i, timestamp_s=50.0 + i / 10)

    def truth(self) -> Trajectory | None:
        return None


def camera_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "camera"]


def released(gate: threading.Event) -> Callable[[float, threading.Event], None]:
    """Return a wait that lets the first frame pass, and the others when the gate is open."""
    first = iter([True])

    def wait(until_s: float, stop: threading.Event) -> None:
        if not next(first, False):
            gate.wait(10)

    return wait


def test_a_late_consumer_gets_the_two_newest_frames() -> None:
    gate = threading.Event()
    source = Arrivals(Clip(), wait=released(gate))
    frames = source.frames_from(0)
    assert next(frames).index == 0
    gate.set()
    for thread in camera_threads():
        thread.join(10)
    assert [frame.index for frame in frames] == [4, 5]
    assert source.dropped == 3


def test_frames_are_held_back_until_their_time() -> None:
    waits: list[float] = []
    source = Arrivals(Clip(), clock=lambda: 7.0, wait=lambda until_s, stop: waits.append(until_s))
    seen = []
    for frame in source.frames_from(0):
        seen.append(frame.index)
        assert source.arrived_s == 7.0
    assert waits == pytest.approx([7.0 + i / 10 for i in range(6)])
    assert len(seen) + source.dropped == 6


def test_a_live_camera_is_not_held_back() -> None:
    waits: list[float] = []
    source = Arrivals(Clip(live=True), wait=lambda until_s, stop: waits.append(until_s))
    assert source.live and len(list(source.frames_from(0))) >= 1 and not waits


def test_work_is_to_end_shortly_before_the_next_frame_is_due() -> None:
    now, gate = [0.0], threading.Semaphore(0)

    def wait(until_s: float, stop: threading.Event) -> None:
        gate.acquire(timeout=10)
        now[0] = until_s

    source = Arrivals(Clip(), clock=lambda: now[0], wait=wait)
    frames = source.frames_from(0)

    def hurries(after_s: float) -> bool:
        gate.release()
        next(frames)
        now[0] += after_s
        return source.hurries()

    assert [hurries(5.0) for _ in range(3)] == [False] * 3, "the time between frames is not known yet"
    for _ in range(2):
        hurries(0.0)
    assert not hurries(0.05)
    now[0] += 0.02
    assert source.hurries()


def test_an_unreadable_frame_ends_the_frames_with_its_error() -> None:
    seen = []
    with pytest.raises(SourceError, match="frame 2 is damaged"):
        for frame in Arrivals(Clip(damaged=2), wait=lambda until_s, stop: None).frames_from(0):
            seen.append(frame.index)
    assert set(seen) <= {0, 1}


def test_a_consumer_that_leaves_ends_the_camera() -> None:
    frames = Arrivals(Clip()).frames_from(0)
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert not camera_threads()
