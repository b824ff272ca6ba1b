"""Read frames from a live camera and record each one; deliver those of a recording at its own times, as cameras do."""

import math
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from queue import Empty, SimpleQueue
from statistics import median

from sigmasplat.api import Camera, Frame, InputConfig, Source, SourceError, Trajectory, Wrapped, read_ahead
from sigmasplat.plugins.sources.tum import TumWriter

WAITING_MOST = 2
"""Maximum number of frames that wait; a third one takes the place of the oldest, which is dropped."""
DUE = 0.6
"""The next frame is due soon if this share of the usual time between frames has passed since the last one arrived."""
USUAL, FEW = 20, 5
"""What is usual is the median over this many recent frames; with fewer than the second number, it is not known."""

Arrival = tuple[Frame, float]
"""A frame, and the time when it arrived."""
Waiting = SimpleQueue[Arrival | BaseException | None]
"""Frames that wait for the consumer; then None, or the error that ended them."""
Wait = Callable[[float, threading.Event], None]
"""Waits for a time, but no longer than until an event is set."""


def wait_until(until_s: float, stop: threading.Event) -> None:
    """Wait until a time of `time.perf_counter`, or until `stop` is set."""
    remaining_s = until_s - time.perf_counter()
    if remaining_s > 0:
        stop.wait(remaining_s)


class Arrivals(Wrapped):
    """A source whose frames do not wait for the consumer: a late consumer gets the newest ones.

    dropped: number of frames that were dropped because the consumer was late; arrived_s: when the last frame arrived,
    in seconds of `clock`; paced: whether each frame is held back until its time, which a live camera does not need.
    """

    def __init__(
        self, whole: Source, clock: Callable[[], float] = time.perf_counter, wait: Wait = wait_until,
    ) -> None:  # fmt: skip
        super().__init__(whole)
        self.live, self.paced = whole.live, not whole.live
        self._clock, self._wait = clock, wait
        self._waiting, self._usual_s = Waiting(), math.inf

    def __len__(self) -> int:
        return len(self._whole)

    def hurries(self) -> bool:
        """Return whether the next frame has arrived already, or is due soon. What is begun then makes that frame
        late."""
        late = self.arrived_s is not None and self._clock() - self.arrived_s > DUE * self._usual_s
        return late or not self._waiting.empty()

    def frame(self, i: int) -> Frame:
        return self._whole.frame(i)

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield frames as they arrive. Raises as the source does."""
        waiting, stop = Waiting(), threading.Event()
        self._waiting, self._usual_s = waiting, math.inf
        thread = threading.Thread(target=self._deliver, args=(first, waiting, stop), name="camera", daemon=True)
        thread.start()
        try:
            while (arrival := waiting.get()) is not None:
                if isinstance(arrival, BaseException):
                    raise arrival
                frame, self.arrived_s = arrival
                yield frame
        finally:
            stop.set()
            thread.join()

    def _deliver(self, first: int, waiting: Waiting, stop: threading.Event) -> None:
        """Put the frames into the queue, then None or the error that ended them."""
        begin_s, end, times_s = None, None, deque[float](maxlen=USUAL + 1)
        frames = self._whole.frames_from(first)
        try:
            for frame in frames:
                if begin_s is None:
                    begin_s = self._clock() - frame.timestamp_s
                if self.paced:
                    self._wait(begin_s + frame.timestamp_s, stop)
                if stop.is_set():
                    return
                if waiting.qsize() >= WAITING_MOST:
                    with suppress(Empty):  # the consumer was faster
                        waiting.get_nowait()
                        self.dropped += 1
                times_s.append(self._clock())
                if len(times_s) > FEW:
                    self._usual_s = median(later - earlier for earlier, later in pairwise(times_s))
                waiting.put((frame, times_s[-1]))
        except BaseException as error:  # passed to the consumer's thread, which raises it
            end = error
        finally:
            waiting.put(end)
            if hasattr(frames, "close"):
                frames.close()


class _NoLength(SourceError, TypeError):
    """The length is unknown. It is a TypeError too, because list() accepts a missing length only as TypeError."""


class LiveSource(Source):
    """A live camera. Frames come once, until the consumer stops, the limit is reached, or the camera fails.

    dropped: number of frames that arrived while the previous one was processed; only the newest is used;
    ending: why the camera stopped, "" if it did not.
    """

    live = True

    def __init__(self, name: str, camera: Camera, settings: InputConfig) -> None:
        super().__init__(name, camera, settings.strict)
        self._settings = settings
        self._writer: TumWriter | None = None
        self.dropped = 0
        self.ending = ""

    def record_to(self, folder: Path) -> None:
        """Record every frame to a new TUM folder. Raises RunError if it holds a sequence or cannot be written."""
        self._writer = TumWriter(folder, self.camera)

    def __len__(self) -> int:
        """Raise SourceError: the length is unknown."""
        raise _NoLength(self._once())

    def frame(self, i: int) -> Frame:
        """Raise SourceError: frames come only once, in order."""
        raise SourceError(self._once())

    def truth(self) -> Trajectory | None:
        return None

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield frames as they arrive, at most one ahead. Raises SourceError if the camera delivers no frame."""
        if first:
            raise SourceError(self._once())
        return read_ahead(self._recorded(), 1)

    @abstractmethod
    def captured(self) -> Iterator[Frame]:
        """Yield the newest frame repeatedly, numbered from 0; stop the camera at the end."""

    def _recorded(self) -> Iterator[Frame]:
        """Yield every stride-th frame between start_s and end_s, seconds after the first frame; record each."""
        settings, index, begin_s = self._settings, 0, None
        for count, frame in enumerate(self.captured()):
            begin_s = frame.timestamp_s if begin_s is None else begin_s
            elapsed_s = frame.timestamp_s - begin_s
            if settings.end_s and elapsed_s >= settings.end_s:
                return
            if elapsed_s < settings.start_s or count % settings.stride:
                continue
            numbered = replace(frame, index=index)
            if self._writer:
                self._writer.add(numbered)
            yield numbered
            index += 1
            if index == settings.limit:
                return

    def _once(self) -> str:
        return f"{self.name}: a live camera delivers each frame once; run it, then read the folder with its recording"


def recording_settings(settings: InputConfig) -> InputConfig:
    """Return the settings for reading the recording of a run, whose frames are already selected and rectified."""
    return InputConfig(
        strict=settings.strict, width=settings.width, crop_px=settings.crop_px,
        min_depth_m=settings.min_depth_m, max_depth_m=settings.max_depth_m, denoise_depth=settings.denoise_depth,
    )  # fmt: skip
