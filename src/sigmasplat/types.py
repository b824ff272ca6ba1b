"""Define the types that many modules share, and the default for an optional callback."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""A float64 array of any shape; the docstring of its function gives the shape, as in T_world_camera [4, 4]."""
Progress = Callable[[int, int], None]
"""Called with (done, total) while a long task runs; a total of 0 is not known yet."""


def no_progress(done: int, total: int) -> None:
    """Ignore the progress of a task: the default where a `Progress` is optional."""


def part_of(progress: Progress, first: int, total: int) -> Progress:
    """Return the progress of one part of a task: its steps are added to the `first` ones, of `total`."""
    return lambda done, _: progress(first + done, total)
