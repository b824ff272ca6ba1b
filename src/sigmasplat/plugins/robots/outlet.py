"""Write messages to a bag on a thread of their own, so that a slow or full disk costs the run nothing.

The run offers jobs and never waits. If the thread is late, jobs are dropped and counted; images are dropped first. An
error of the disk ends the outlet, and the run goes on.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from sigmasplat.plugins.robots.bag import BagSink
from sigmasplat.plugins.robots.ros_messages import Encoded, RosMessages

Job = Callable[[RosMessages], Iterable[Encoded]]
"""Makes messages. It runs on the outlet's thread, so it may read only data that the run no longer changes."""
MOST_JOBS, MOST_BULKY = 256, 16
"""At most this many jobs wait, and at most this many with images: 5 MB each at 640×480."""
CLOSE_S = 30.0
"""At the end, the thread has this many seconds to write what waits."""


class Outlet:
    """A thread with a bounded queue in front of a bag.

    written: number of messages; dropped: number of jobs that were dropped because the thread was late, or because the
    bag had failed; failure: why it failed, "" if it did not.
    """

    def __init__(self, sink: BagSink, messages: RosMessages) -> None:
        self.sink, self.messages = sink, messages
        self.written, self.dropped, self.failure = 0, 0, ""
        self._jobs = deque[tuple[Job, bool]]()
        self._bulky = 0
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="sigmasplat-bag", daemon=True)
        self._thread.start()

    def offer(self, job: Job, bulky: bool = False) -> None:
        """Add a job that makes messages; drop it if too many wait. Never waits for the bag."""
        with self._changed:
            if self.failure or self._closing or len(self._jobs) >= MOST_JOBS or (bulky and self._bulky >= MOST_BULKY):
                self.dropped += 1
                return
            self._jobs.append((job, bulky))
            self._bulky += bulky
            self._changed.notify()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Write what waits and complete the bag, for at most `timeout_s`; then drop the rest."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            with self._changed:
                self._fail(f"not finished {timeout_s:g} s after the run")

    def record(self) -> dict[str, Any]:
        """Return counts and failure as values for run.json."""
        return {"written": self.written, "dropped": self.dropped, "failure": self.failure}

    def _work(self) -> None:
        """Write until the end. The bag is opened at the first job, so that a run without frames leaves no file."""
        try:
            if (job := self._next()) is None:
                return
            self.sink.open(self.messages)
            while job is not None:
                for message in job(self.messages):
                    self.sink.write(message)
                    self.written += 1
                job = self._next()
            if not self.failure:
                self.sink.close()
        except Exception as problem:
            with self._changed:
                self._fail(_reason(problem))
            self.sink.abort()

    def _next(self) -> Job | None:
        with self._changed:
            self._changed.wait_for(lambda: bool(self._jobs) or self._closing)
            if not self._jobs:
                return None
            job, bulky = self._jobs.popleft()
            self._bulky -= bulky
            return job

    def _fail(self, reason: str) -> None:
        self.failure = self.failure or reason
        self.dropped += len(self._jobs)
        self._jobs.clear()


def _reason(problem: Exception) -> str:
    if isinstance(problem, OSError) and problem.strerror:
        return problem.strerror
    return f"{type(problem).__name__}: {problem}".splitlines()[0]
