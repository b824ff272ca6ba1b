"""Measure how long the stages of a computation take."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field


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
