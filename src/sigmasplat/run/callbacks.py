"""Define what a session calls: callbacks with its progress, and a checkpointer that saves its state."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sigmasplat.graph.loops import Loop
    from sigmasplat.slam.results import Step


class Callback:
    """Receives the progress of a session; this one does nothing with it."""

    def __call__(self, step: "Step") -> None:
        """Handle a step."""

    def finishing(self, done: int, total: int) -> None:
        """Handle the progress of the final map."""

    def last_loops(self, loops: Sequence["Loop"]) -> None:
        """Handle the loops tried after the last step."""


class CallbackList(Callback):
    """Calls several callbacks in order."""

    def __init__(self, *callbacks: Callback) -> None:
        self.callbacks = callbacks

    def __call__(self, step: "Step") -> None:
        """Call every callback with a step."""
        for callback in self.callbacks:
            callback(step)

    def finishing(self, done: int, total: int) -> None:
        """Call every callback with the progress of the final map."""
        for callback in self.callbacks:
            callback.finishing(done, total)

    def last_loops(self, loops: Sequence["Loop"]) -> None:
        """Call every callback with the loops tried after the last step."""
        for callback in self.callbacks:
            callback.last_loops(loops)


class BetweenFrames(CallbackList):
    """Calls a callback in tasks of a system in real time, so that it reads the system between two frames."""

    def __init__(self, callback: Callback, run: Callable[[Callable[[], None]], None]) -> None:
        super().__init__(callback)
        self.run = run

    def __call__(self, step: "Step") -> None:
        """Call the callback with a step as soon as the step's frame is in the map."""
        self.run(lambda: super(BetweenFrames, self).__call__(step))


class Checkpointer:
    """Saves the state that a stopped run resumes from (`resume.StateFile`); this one saves nothing."""

    def after_frame(self, index: int, wall_s: float) -> None:
        """Save the state after source frame `index` if a save is due."""

    def save(self, index: int, wall_s: float) -> None:
        """Save the state after source frame `index`, `wall_s` seconds into the run."""

    def delete(self) -> None:
        """Delete the saved state."""
