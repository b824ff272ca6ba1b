"""Define the types that many modules share, and the default for an optional callback."""

from collections.abc import Callable, Generator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""A float64 array of any shape; the docstring of its function gives the shape, as in T_world_camera [4, 4]."""
Progress = Callable[[int, int], None]
"""Called with (done, total) while a long task runs; a total of 0 is not known yet."""
Result = TypeVar("Result")
Task = Generator[None, None, Result]
"""A long task in slices: it yields after each slice, and returns its result after the last one."""


def long_slice() -> Task[None]:
    """End a slice that takes as long as several others: it counts as three."""
    for _ in range(3):
        yield


def completed(slices: Task[Result]) -> Result:
    """Run all slices of a task and return its result."""
    while True:
        try:
            next(slices)
        except StopIteration as end:
            result: Result = end.value
            return result


def no_progress(done: int, total: int) -> None:
    """Ignore the progress of a task: the default where a `Progress` is optional."""


def part_of(progress: Progress, first: int, total: int) -> Progress:
    """Return the progress of one part of a task: its steps are added to the `first` ones, of `total`."""
    return lambda done, _: progress(first + done, total)
