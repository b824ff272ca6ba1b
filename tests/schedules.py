"""Deterministic schedules of the work on the map: every interleaving with tracking can be made again."""

from collections.abc import Iterator

import numpy as np


class AtOnce:
    """All work is done before the next frame."""

    def start(self, work: Iterator[bool]) -> None:
        self.work = work

    def wake(self) -> None:
        while next(self.work, False):
            pass

    def settle(self) -> None:
        AtOnce.wake(self)

    def stop(self) -> None:
        pass


class Drawn(AtOnce):
    """A random number of slices is done after each frame: often none, sometimes all that is left."""

    def __init__(self, seed: int, most: int = 30) -> None:
        self.random, self.most = np.random.default_rng(seed), most

    def wake(self) -> None:
        kind = self.random.random()
        if kind < 0.1:
            super().wake()
        elif kind > 0.5:
            for _ in range(int(self.random.integers(self.most))):
                if not next(self.work, False):
                    return


class Late(AtOnce):
    """At most a number of slices is done after each frame."""

    def __init__(self, slices: int) -> None:
        self.slices = slices

    def wake(self) -> None:
        for _ in range(self.slices):
            if not next(self.work, False):
                return
