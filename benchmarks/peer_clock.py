"""A clock for the programs that run other systems (peer_*.py): time of each frame, processor time; needs numpy only."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

SECONDS, TOTALS = "seconds.npy", "clock.json"


class Clock:
    """Measures the call that returns the pose of each frame, and the frames together; waiting is counted apart.

    Processor time is that of all threads, from the end of the first frame's call on: libraries are loaded in it.
    """

    def __init__(self) -> None:
        self.calls_s, self.waited_s = list[float](), 0.0
        self.started_s = time.perf_counter()
        self.second_frame = (0.0, 0.0)

    @contextmanager
    def call(self) -> Iterator[None]:
        """Measure the call for the next frame."""
        begun_s = time.perf_counter()
        try:
            yield
        finally:
            ended_s = time.perf_counter()
            if not self.calls_s:
                self.second_frame = ended_s, time.process_time()
            self.calls_s.append(ended_s - begun_s)

    def wait(self, seconds: float) -> None:
        """Sleep for this time if it is not negative: the time until the next frame is there."""
        begun_s = time.perf_counter()
        time.sleep(max(0.0, seconds))
        self.waited_s += time.perf_counter() - begun_s

    def write(self, folder: Path) -> None:
        """Write seconds.npy (float64 [N], s) and clock.json; call it right after the last frame."""
        now_s, processor_s = time.perf_counter(), time.process_time()
        np.save(folder / SECONDS, np.array(self.calls_s))
        totals = {
            "wall_s": now_s - self.started_s, "waited_s": self.waited_s,
            "later_wall_s": now_s - self.second_frame[0], "later_processor_s": processor_s - self.second_frame[1],
        }  # fmt: skip
        (folder / TOTALS).write_text(json.dumps(totals))
