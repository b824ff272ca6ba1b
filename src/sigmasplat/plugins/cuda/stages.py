"""Measure the stages of renders on a CUDA device with events on its stream; the host waits only when times are read."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

STAGES = ("project", "sort", "blend", "blend_backward", "project_backward")
"""The stages of `View.seconds`, in its order."""

_asked = False


def measure(asked: bool = True) -> None:
    """Start or stop counting `seconds` in CUDA views; `run --profile` starts it."""
    global _asked
    _asked = asked


def measured() -> bool:
    """Return whether stages are measured."""
    return _asked


class Event(Protocol):
    """A mark on a stream, as `torch.cuda.Event(enable_timing=True)`."""

    def record(self) -> None: ...
    def query(self) -> bool: ...
    def synchronize(self) -> None: ...
    def elapsed_time(self, end: Any, /) -> float: ...


class Stages:
    """Times between pairs of events on the current stream, by stage. Pairs that have passed are summed from time to
    time.

    Unless `measure` was called there are no events, and all stages take 0 s.
    """

    def __init__(self, event: Callable[[], Event] | None = None) -> None:
        self._event = event or _timed
        self._pending: deque[tuple[int, Event, Event]] = deque()
        self._passed: list[Event] = []
        self._seconds = np.zeros(len(STAGES))

    def of(self, stage: str) -> AbstractContextManager[None]:
        """Add the device's time for a block of code to a stage."""
        return self._between(stage) if _asked else nullcontext()

    @contextmanager
    def _between(self, stage: str) -> Iterator[None]:
        begin, end = self._taken(), self._taken()
        begin.record()
        try:
            yield
        finally:
            end.record()
            self._pending.append((STAGES.index(stage), begin, end))
        while self._pending and self._pending[0][2].query():
            self._add()

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Return the time spent so far by stage [5]. Waits for events that have not passed yet."""
        if self._pending:
            self._pending[-1][2].synchronize()
        while self._pending:
            self._add()
        return self._seconds.copy()

    def _add(self) -> None:
        stage, begin, end = self._pending.popleft()
        self._seconds[stage] += begin.elapsed_time(end) / 1000.0
        self._passed += [begin, end]

    def _taken(self) -> Event:
        return self._passed.pop() if self._passed else self._event()


def _timed() -> Event:
    event: Event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    return event
