"""The number of threads of the kernels, and the priority of threads that do not have to be on time."""

import os
import sys
import threading
from contextlib import suppress

from sigmasplat.native import _core

NICENESS = 5
"""How much a thread yields if another one wants the same core. With a larger value, other programs keep it from running
while it holds the interpreter lock, and tracking has to wait for it."""


def set_kernel_threads(count: int) -> int:
    """Set the number of threads that the CPU kernels use when the calling thread calls them, and return the number
    before; 0 = no change."""
    before = _core.threads()
    if count:
        _core.set_threads(count)
    return before


def idle_kernel_workers() -> None:
    """Let the threads that help the calling thread in the CPU kernels run only where a core is idle (Linux). They hold
    no lock, so no other thread waits for them."""
    _core.idle_workers()


def yield_to_others() -> None:
    """Lower the priority of the calling thread, and of the threads that it starts. No effect on other systems, or where
    a sandbox forbids it."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
