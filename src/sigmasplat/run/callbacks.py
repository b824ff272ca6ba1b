"""Define what a session calls with its progress, and how Ctrl-C and the signals that end a process stop it."""

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
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


STANDARD_OUTPUTS = (1, 2)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C; `kill`, a container or a scheduler; a closed terminal."""


@contextmanager
def interrupt_event() -> Iterator[threading.Event]:
    """Convert the first of the signals to an event, so that no step is interrupted; the next one raises
    KeyboardInterrupt.

    A signal that the process ignores (nohup) stays ignored, except Ctrl-C. Outside the main thread signals cannot be
    handled, and the event is never set.
    """
    interrupt = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    terminals = [output for output in STANDARD_OUTPUTS if os.isatty(output)]

    def on_first(number: int, frame: FrameType | None) -> None:
        interrupt.set()
        if number == signal.SIGHUP:
            _discard(terminals)
        for ending in earlier:
            signal.signal(ending, on_next)

    def on_next(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    handled = [s for s in ENDING if s == signal.SIGINT or signal.getsignal(s) != signal.SIG_IGN]
    earlier = {ending: signal.signal(ending, on_first) for ending in handled}
    try:
        yield interrupt
    finally:
        for ending, handler in earlier.items():
            signal.signal(ending, handler)


def _discard(outputs: list[int]) -> None:
    """Send what is printed to a closed terminal nowhere, since writing to it would fail."""
    with suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for output in outputs:
            os.dup2(nowhere, output)
        os.close(nowhere)
