"""Say what a session asks of the system that it runs and of those who watch it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.types import Progress


class LoopResult(Protocol):
    """What a session reads of a pair of submaps that may be a loop (slam.loops.Loop)."""

    @property
    def query(self) -> int: ...
    @property
    def database(self) -> int: ...
    @property
    def accepted(self) -> bool: ...
    @property
    def residual(self) -> float: ...
    @property
    def translation_m(self) -> float: ...
    def record(self) -> dict[str, Any]: ...


class StepResult(Protocol):
    """What a session reads of a step (slam.slam.Step)."""

    @property
    def index(self) -> int: ...
    @property
    def timestamp_s(self) -> float: ...
    @property
    def T_world_camera(self) -> NDArray[np.float64]: ...
    @property
    def is_keyframe(self) -> bool: ...
    @property
    def lost(self) -> bool: ...
    @property
    def tracking(self) -> Mapping[str, float]: ...
    @property
    def splats(self) -> int: ...
    @property
    def submap(self) -> int: ...
    @property
    def loops(self) -> Sequence[LoopResult]: ...
    @property
    def seconds(self) -> Mapping[str, float]: ...


class SlamSystem(Protocol):
    """What a session needs of a system (slam.slam.Slam)."""

    @property
    def field(self) -> GaussianField: ...
    @property
    def loops(self) -> Sequence[LoopResult]: ...
    def step(self, frame: Frame) -> StepResult: ...
    def finish(self, progress: Progress) -> None: ...
    def trajectory(self) -> Trajectory: ...
    def checkpoint(self) -> dict[str, Tensor]: ...


class Callback(Protocol):
    """Is told how a session goes."""

    def __call__(self, step: StepResult) -> None:
        """Take note of a step."""

    def finishing(self, done: int, total: int) -> None:
        """Take note of how far the final map is."""

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Take note of the loops tried after the last step."""


class NullCallback:
    """Takes note of nothing."""

    def __call__(self, step: StepResult) -> None: ...
    def finishing(self, done: int, total: int) -> None: ...
    def last_loops(self, loops: Sequence[LoopResult]) -> None: ...


class CallbackList:
    """Several watchers, told one after the other."""

    def __init__(self, *watchers: Callback) -> None:
        self.watchers = watchers

    def __call__(self, step: StepResult) -> None:
        """Take note of a step."""
        for watcher in self.watchers:
            watcher(step)

    def finishing(self, done: int, total: int) -> None:
        """Take note of how far the final map is."""
        for watcher in self.watchers:
            watcher.finishing(done, total)

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Take note of the loops tried after the last step."""
        for watcher in self.watchers:
            watcher.last_loops(loops)
