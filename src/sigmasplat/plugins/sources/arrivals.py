"""Deliver the frames of a source when they arrive: those of a recording at its own times, as a camera would."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import NamedTuple, Protocol

from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.source import Source

WAITING_MOST = 2
"""Maximum number of frames that wait; a third one takes the place of the oldest, which is dropped."""
DUE = 0.6
"""The next frame is due soon if this share of the usual time between frames has passed since the last one arrived."""
USUAL, FEW = 20, 5
"""What is usual is the median over this many recent frames; with fewer than the second number, it is not known."""


class Arrival(NamedTuple):
    """A frame and the time when it arrived."""

    frame: Frame
    arrived_s: float


class Waiting(Protocol):
    """Waits for a time, but no longer than until an event is set."""

    def __call__(self, until_s: float, stop: threading.Event) -> None: ...


def wait_until(until_s: float, stop: threading.Event) -> None:
    """Wait until a time of `time.perf_counter`, or until `stop` is set."""
    remaining_s = until_s - time.perf_counter()
    if remaining_s > 0:
        stop.wait(remaining_s)


class Arrivals(Source):
    """A source whose frames do not wait for the consumer: a late consumer gets the newest ones.

    dropped: number of frames that were dropped because the consumer was late; arrived_s: when the last frame arrived,
    in seconds of `clock`; paced: whether each frame is held back until its time, which a live camera does not need.
    """

    def __init__(
        self, whole: Source, clock: Callable[[], float] = time.perf_counter, wait: Waiting = wait_until,
    ) -> None:  # fmt: skip
        super().__init__(whole.name, whole.camera, whole.strict)
        self.skipped, self.live, self.paced = whole.skipped, whole.live, not whole.live
        self.depth_units_per_metre = whole.depth_units_per_metre
        self.depth_registered, self.registrable = whole.depth_registered, whole.registrable
        self.dropped = 0
        self._whole, self._clock, self._wait = whole, clock, wait
        self._queue = _Newest()

    def __len__(self) -> int:
        return len(self._whole)

    def hurries(self) -> bool:
        """Return whether the next frame has arrived already, or is due soon. What is begun then makes that frame
        late."""
        late = self.arrived_s is not None and self._clock() - self.arrived_s > DUE * self._queue.usual_s
        return late or self._queue.waits

    def frame(self, i: int) -> Frame:
        """Read frame i at once."""
        return self._whole.frame(i)

    def truth(self) -> Trajectory | None:
        """Return the ground-truth path of the source."""
        return self._whole.truth()

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield frames as they arrive. Raises as the source does."""
        queue = self._queue = _Newest()
        thread = threading.Thread(target=self._deliver, args=(first, queue), name="camera", daemon=True)
        thread.start()
        try:
            while (arrival := queue.get()) is not None:
                self.arrived_s = arrival.arrived_s
                yield arrival.frame
        finally:
            queue.stop.set()
            thread.join()
            self.dropped += queue.dropped

    def _deliver(self, first: int, queue: "_Newest") -> None:
        begin_s: float | None = None
        frames = self._whole.frames_from(first)
        try:
            for frame in frames:
                if begin_s is None:
                    begin_s = self._clock() - frame.timestamp_s
                if self.paced:
                    self._wait(begin_s + frame.timestamp_s, queue.stop)
                if queue.stop.is_set():
                    return
                queue.put(Arrival(frame, self._clock()))
            queue.end(None)
        except BaseException as error:  # passed to the consumer's thread, which raises it
            queue.end(error)
        finally:
            if hasattr(frames, "close"):
                frames.close()


@dataclass(eq=False)
class _Newest:
    """The frames that wait for the consumer; usual_s: the usual time between frames, infinite if it is not known."""

    def __post_init__(self) -> None:
        self.stop, self.dropped, self.usual_s = threading.Event(), 0, math.inf
        self._arrived_s = deque[float](maxlen=USUAL + 1)
        self._changed, self._frames = threading.Condition(), deque[Arrival]()
        self._ended, self._error = False, None

    _error: BaseException | None = None

    @property
    def waits(self) -> bool:
        """Return whether a frame waits."""
        return bool(self._frames)

    def put(self, arrival: Arrival) -> None:
        """Add a frame; drop the oldest if too many wait."""
        with self._changed:
            if len(self._frames) == WAITING_MOST:
                self._frames.popleft()
                self.dropped += 1
            self._frames.append(arrival)
            self._arrived_s.append(arrival.arrived_s)
            if len(self._arrived_s) > FEW:
                self.usual_s = median(later - earlier for earlier, later in pairwise(self._arrived_s))
            self._changed.notify()

    def end(self, error: BaseException | None) -> None:
        """Note that no frame follows, and why."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify()

    def get(self) -> Arrival | None:
        """Wait for a frame; return None after the last one. Raises what the source raised."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._ended)
            if self._frames:
                return self._frames.popleft()
            if self._error is not None:
                raise self._error
            return None
