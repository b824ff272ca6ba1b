"""The priority of threads that do not have to be on time: tracking, which has to, comes first (Linux)."""

import os
import sys
import threading

NICENESS = 5
"""How much a thread yields if another one wants the same core. With a larger value, other programs keep it from running
while it holds the interpreter lock, and tracking has to wait for it."""


def yield_to_others() -> None:
    """Lower the priority of the calling thread, and of the threads that it starts; no effect on other systems."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
