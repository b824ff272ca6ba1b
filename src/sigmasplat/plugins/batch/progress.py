"""Estimate how long the runs of a batch still take, and count their frames while they run."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from sigmasplat.plugins.batch.job import Job
from sigmasplat.types import Progress

LOOK_EVERY_S = 2.0


class Estimate:
    """Estimates the time left from the seconds per frame of finished runs, separately for each preset.

    frames: number of frames of each job, by its name; slots: number of runs at the same time.
    """

    def __init__(self, frames: Mapping[str, int], slots: int) -> None:
        self.frames, self.slots = frames, slots
        self.seconds = dict[str, float]()
        self.counted = dict[str, int]()

    def add(self, job: Job, seconds: float) -> None:
        """Add a finished run."""
        preset = job.config.name
        self.seconds[preset] = self.seconds.get(preset, 0.0) + seconds
        self.counted[preset] = self.counted.get(preset, 0) + self.frames[job.name]

    def left_s(self, jobs: Sequence[Job]) -> float | None:
        """Return the seconds that these jobs still take, None before the first run has finished.

        Presets without a finished run count with the mean of the others.
        """
        if not any(self.counted.values()):
            return None
        mean = sum(self.seconds.values()) / sum(self.counted.values())
        rates = {preset: self.seconds[preset] / frames for preset, frames in self.counted.items() if frames}
        return sum(rates.get(job.config.name, mean) * self.frames[job.name] for job in jobs) / self.slots


def duration(seconds: float) -> str:
    """Write a duration with its largest unit, and the next smaller one below ten: 45 s, 12 min, 3 h 20 min, 2 d 5 h."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{round(seconds)} s"
    if minutes < 100:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"


@contextmanager
def frames_counted(jobs: Sequence[Job], frames: Mapping[str, int], out: Path, show: Progress) -> Iterator[None]:
    """Call `show(done, total)` with the frames of all runs from time to time, as read from their logs."""
    total, ended = sum(frames[job.name] for job in jobs), threading.Event()

    def look() -> None:
        while not ended.wait(LOOK_EVERY_S):
            show(sum(_logged(out / job.name) for job in jobs), total)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _logged(folder: Path) -> int:
    with suppress(OSError):
        return (folder / "log.jsonl").read_bytes().count(b"\n")
    return 0
