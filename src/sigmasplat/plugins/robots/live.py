"""Write a run that goes on to a bag: transforms, odometry, images.

Messages are made and written on a thread of their own, so that a slow or full disk costs the run nothing. The run
offers jobs and never waits. If the thread is late, jobs are dropped and counted; images are dropped first. An error of
the disk ends the bag, and the run goes on.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Literal

from sigmasplat.api import Callback, Frame, Matrix, Slam, Step
from sigmasplat.plugins.robots import ros_messages as ros
from sigmasplat.plugins.robots.bag import BagSink
from sigmasplat.plugins.robots.odometry import LiveOdometry, has_motion
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


Images = Literal["none", "keyframes", "all"]
STATIC = ((ros.MAP, ros.WORLD, ros.T_MAP_WORLD), (ros.LINK, ros.OPTICAL, ros.T_LINK_OPTICAL))


class LiveRobot(Callback):
    """Gives messages to an outlet.

    It copies small data in the thread of the run. Messages are made and written on the thread of the outlet. images:
    of which frames images are given. warn: prints a line if the outlet fails.
    """

    def __init__(self, slam: Slam, outlet: Outlet, warn: Callable[[str], None], images: Images = "keyframes") -> None:
        self.outlet, self.warn, self.images = outlet, warn, images
        self.odometry = LiveOdometry(slam.atlas)
        self._frames = dict[int, Frame]()
        self._stamp_ns = -1
        self._warned = False

    def watch(self, frame: Frame) -> None:
        """Keep a frame until its step, if its images may be wanted."""
        if self.images != "none":
            self._frames[frame.index] = frame

    def __call__(self, step: Step) -> None:
        """Give the messages of a step to the outlet."""
        self._now(step.timestamp_s)
        self._offer_images(step, self._frame_of(step))
        moved = has_motion(step.state, step.tracking)
        T_odom_camera = self.odometry.step(moved, step.lost)
        if not step.lost:
            self._offer_pose(step, T_odom_camera)
        self._report_failure()

    def close(self) -> None:
        """Write what waits, and report if the outlet failed."""
        self.outlet.close()
        self._report_failure()

    # ---- in the thread of the run; jobs are called on the thread of the outlet ----

    def _now(self, timestamp_s: float) -> None:
        """Set the time of the next messages; the first time, give the static transforms."""
        first, self._stamp_ns = self._stamp_ns < 0, ros.stamp_of(timestamp_s)
        if first:
            stamp_ns = self._stamp_ns
            self.outlet.offer(lambda messages: [messages.transforms(ros.TF_STATIC, stamp_ns, STATIC)])

    def _frame_of(self, step: Step) -> Frame | None:
        """Return the frame of a step if it was kept; forget those that real time dropped."""
        frame = self._frames.pop(step.index, None)
        for index in list(self._frames):  # a copy: in real time `watch` runs on another thread
            if index < step.index:
                del self._frames[index]
        return frame

    def _offer_images(self, step: Step, frame: Frame | None) -> None:
        wanted = self.images == "all" or (self.images == "keyframes" and step.is_keyframe)
        if frame is not None and wanted:
            image = self._stamp_ns, frame.camera, frame.color, frame.depth_m
            self.outlet.offer(lambda messages: messages.images(*image), bulky=True)

    def _offer_pose(self, step: Step, T_odom_camera: Matrix) -> None:
        """Give the transforms and the odometry of a frame that is not lost.

        If the frame's component is not connected to the world, map → odom is not known and left out.
        """
        T_odom_link = ros.link_pose(ros.T_LINK_OPTICAL @ T_odom_camera)
        links = ros.camera_links(
            T_odom_link, None if step.component else ros.link_pose(ros.T_MAP_WORLD @ step.T_world_camera)
        )
        stamp_ns = self._stamp_ns

        def job(messages: RosMessages) -> list[Encoded]:
            odometry = messages.odometry(stamp_ns, ros.ODOM, ros.LINK, T_odom_link, None)
            return [messages.transforms(ros.TF, stamp_ns, links), odometry]

        self.outlet.offer(job)

    def _report_failure(self) -> None:
        if self.outlet.failure and not self._warned:
            self._warned = True
            self.warn(f"the bag ended ({self.outlet.failure}) after {self.outlet.written} messages; the run goes on")
