"""Recordings replayed at another rate: copies of their lists of frames with other times, and links to their images."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

LISTS = "rgb.txt", "depth.txt", "groundtruth.txt"
"""Files of a recording (TUM format) whose first column is a time in seconds."""
SAME = 0.02
"""A rate that differs by at most this share is kept."""


@contextmanager
def at_rate(recording: Path, rate_hz: float) -> Iterator[Path]:
    """Yield a folder with the recording at `rate_hz` frames per second: all times are multiplied by one factor.

    Yields the recording itself if its median rate is the wanted one, or if it has no list of frames.
    """
    frames = recording / LISTS[0]
    factor = rate_of(frames) / rate_hz if frames.is_file() else 1.0
    if abs(factor - 1.0) <= SAME:
        yield recording
        return
    with TemporaryDirectory() as scratch:
        copy = Path(scratch) / recording.name
        copy.mkdir()
        for path in recording.iterdir():
            if path.name in LISTS:
                (copy / path.name).write_text(scaled(path.read_text(), factor))
            else:
                os.symlink(path.resolve(), copy / path.name)
        yield copy


def rate_of(frames: Path) -> float:
    """Return the median rate of a list of frames, in frames per second."""
    times_s = [float(line.split()[0]) for line in frames.read_text().splitlines() if is_row(line)]
    return 1.0 / float(np.median(np.diff(times_s)))


def scaled(text: str, factor: float) -> str:
    """Return a list with all times multiplied by a factor."""
    return "".join(scaled_row(line, factor) if is_row(line) else line for line in text.splitlines(keepends=True))


def scaled_row(line: str, factor: float) -> str:
    """Return a row with its time multiplied by a factor."""
    time_s, rest = line.split(maxsplit=1)
    return f"{factor * float(time_s):.6f} {rest}"


def is_row(line: str) -> bool:
    """Return whether a line is a row of the list: neither empty nor a comment."""
    return bool(line.strip()) and not line.startswith("#")
