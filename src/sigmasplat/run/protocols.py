"""Define what a session needs from the SLAM system, from callbacks and from checkpointers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.data.component import Component
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.map_uncertainty import MapUncertainty
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.types import Progress


class LoopResult(Protocol):
    """The values that a session reads from a tested pair of submaps (slam.loop_closure.closer.Loop)."""

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
    """The values that a session reads from a step (slam.step_result.Step)."""

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
    @property
    def state(self) -> str: ...
    @property
    def component(self) -> int: ...
    @property
    def p_off(self) -> float: ...


class SlamSystem(Protocol):
    """The interface that a session needs from its SLAM system (slam.slam.Slam)."""

    @property
    def field(self) -> GaussianField: ...
    @property
    def loops(self) -> Sequence[LoopResult]: ...
    @property
    def uncertainty(self) -> MapUncertainty | None:
        """Return how sure the final map is, if it was measured."""
        ...

    @property
    def refinement_steps(self) -> int | None:
        """Return the number of refinement steps of the final map, if it was made."""
        ...

    def step(self, frame: Frame) -> StepResult: ...
    def finish(self, progress: Progress) -> None: ...
    def settle(self) -> None:
        """Finish the work on all frames so far; after that, the results below include them."""

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames, including lost ones."""
        ...

    def valid(self) -> NDArray[np.bool_]:
        """Return whether the pose of each frame is valid [F]: tracked or relocalised, and connected to the world."""
        ...

    def components(self) -> Sequence[Component]:
        """Return the components of the atlas that are not connected to the world."""
        ...

    def checkpoint(self) -> dict[str, Tensor]: ...


class Callback(Protocol):
    """Receives the progress of a session."""

    def __call__(self, step: StepResult) -> None:
        """Handle a step."""

    def finishing(self, done: int, total: int) -> None:
        """Handle the progress of the final map."""

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Handle the loops tried after the last step."""


class NullCallback:
    """Does nothing."""

    def __call__(self, step: StepResult) -> None: ...
    def finishing(self, done: int, total: int) -> None: ...
    def last_loops(self, loops: Sequence[LoopResult]) -> None: ...


class CallbackList:
    """Calls several callbacks in order."""

    def __init__(self, *callbacks: Callback) -> None:
        self.callbacks = callbacks

    def __call__(self, step: StepResult) -> None:
        """Call every callback with a step."""
        for callback in self.callbacks:
            callback(step)

    def finishing(self, done: int, total: int) -> None:
        """Call every callback with the progress of the final map."""
        for callback in self.callbacks:
            callback.finishing(done, total)

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Call every callback with the loops tried after the last step."""
        for callback in self.callbacks:
            callback.last_loops(loops)


class BetweenFrames:
    """Calls another callback in tasks of a system in real time, so that it reads the system between two frames."""

    def __init__(self, callback: Callback, run: Callable[[Callable[[], None]], None]) -> None:
        self.callback, self.run = callback, run

    def __call__(self, step: StepResult) -> None:
        """Call the callback with a step as soon as the step's frame is in the map."""
        self.run(lambda: self.callback(step))

    def finishing(self, done: int, total: int) -> None:
        """Call the callback with the progress of the final map."""
        self.callback.finishing(done, total)

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Call the callback with the loops tried after the last step."""
        self.callback.last_loops(loops)


class Checkpointer(Protocol):
    """Saves the state that a stopped run resumes from (resume.StateFile)."""

    def after_frame(self, index: int, wall_s: float) -> None:
        """Save the state after source frame `index` if a save is due."""

    def save(self, index: int, wall_s: float) -> None:
        """Save the state after source frame `index`, `wall_s` seconds into the run."""

    def delete(self) -> None:
        """Delete the saved state."""


class NullCheckpointer:
    """Saves nothing."""

    def after_frame(self, index: int, wall_s: float) -> None: ...
    def save(self, index: int, wall_s: float) -> None: ...
    def delete(self) -> None: ...
