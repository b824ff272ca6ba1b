"""Run the work on the map beside tracking: on a thread of its own."""

import gc
import sys
import threading
from collections.abc import Iterator

from sigmasplat import env
from sigmasplat.native.threads import idle_kernel_workers, set_kernel_threads, yield_to_others

SWITCH_S = 0.0005
"""How long a thread may hold the interpreter lock while another one waits for it; Python's default is 5 ms."""


class MappingThread:
    """Runs slices of work in a thread, which sleeps while nothing is to be done. The work is an iterator without end:
    it yields True after a slice, and False when nothing is left to do for now.

    While it runs, Python's garbage collector leaves out what existed at its start (`gc.freeze`): searching the 200 000
    objects of the loaded libraries stops all threads for 160 ms.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._pending, self._idle, self._stopped = False, True, False
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None
        self._switch_s = sys.getswitchinterval()

    def start(self, work: Iterator[bool]) -> None:
        """Start the thread."""
        sys.setswitchinterval(SWITCH_S)
        gc.freeze()
        self._idle = False  # until the thread waits for work: `settle` reports what fails before that
        self._thread = threading.Thread(target=self._run, args=(work,), name="mapping", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Let the thread continue. Raises what a slice has raised."""
        with self._changed:
            self._pending = True
            self._changed.notify_all()
            self._raise()

    def settle(self) -> None:
        """Wait until nothing is left to do. Raises what a slice has raised."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._error is not None or self._stopped or (self._idle and not self._pending)
            )
            self._raise()

    def stop(self) -> None:
        """End the thread after the slice that it runs."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            sys.setswitchinterval(self._switch_s)
            gc.unfreeze()

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _run(self, work: Iterator[bool]) -> None:
        try:
            yield_to_others()
            set_kernel_threads(env.switches().threads)
            idle_kernel_workers()
            while self._continues():
                while next(work) and not self._stopped:
                    pass
        except BaseException as error:  # passed to the tracking thread, which raises it
            with self._changed:
                self._error, self._stopped = error, True
                self._changed.notify_all()

    def _continues(self) -> bool:
        """Wait for new work; return whether there is some."""
        with self._changed:
            self._idle = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._pending or self._stopped)
            self._pending = self._idle = False
            return not self._stopped
