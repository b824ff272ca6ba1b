"""Define what a session calls with its progress."""

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


def run_now(task: Callable[[], None]) -> None:
    """Run a task at once."""
    task()
