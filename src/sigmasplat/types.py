"""Define the types that many modules share, the default for an optional callback, and the stopwatch of stages."""

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""A float64 array of any shape; the docstring of its function gives the shape, as in T_world_camera [4, 4]."""
Progress = Callable[[int, int], None]
"""Called with (done, total) while a long task runs; a total of 0 is not known yet."""
ShouldStop = Callable[[], bool]
"""Asked again and again during long work."""
Item = TypeVar("Item")
Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")
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


def at_once(task: Callable[Arguments, Task[Result]]) -> Callable[Arguments, Result]:
    """Return the function that runs a task from its first slice to its last."""
    return lambda *args, **options: completed(task(*args, **options))


def no_progress(done: int, total: int) -> None:
    """Ignore the progress of a task: the default where a `Progress` is optional."""


def part_of(progress: Progress, first: int, total: int) -> Progress:
    """Return the progress of one part of a task: its steps are added to the `first` ones, of `total`."""
    return lambda done, _: progress(first + done, total)


def never() -> bool:
    """Return False."""
    return False


def unless(should_stop: ShouldStop, guesses: Iterable[Item]) -> Iterator[Item]:
    """Yield guesses while `should_stop` returns False; a guess is not made before it is asked."""
    waiting = iter(guesses)
    while not should_stop():
        try:
            yield next(waiting)
        except StopIteration:
            return


@dataclass(eq=False)
class Stopwatch:
    """Sums wall-clock seconds by stage. Stages can be nested: each one counts its whole time."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a block of code to a stage, even if the block raises."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: time.perf_counter() - begin})

    def add(self, seconds: Mapping[str, float], prefix: str = "") -> None:
        """Add seconds by stage that were measured elsewhere; `prefix` is put before each name."""
        for name, spent in seconds.items():
            self.seconds[prefix + name] = self.seconds.get(prefix + name, 0.0) + spent
