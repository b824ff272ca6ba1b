"""SLAM in real time: a frame is tracked at once, and the work on the map never makes it wait."""

import gc
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from sigmasplat import env
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import SensorTimes
from sigmasplat.graph.loops import Loops
from sigmasplat.native.threads import idle_kernel_workers, set_kernel_threads, yield_to_others
from sigmasplat.realtime.back_end import BackEnd
from sigmasplat.realtime.front_end import FrontEnd, Snapshot, TrackedFrame
from sigmasplat.render.view import View
from sigmasplat.slam.results import Step, StepTimer
from sigmasplat.system.array_interface import ArrayInterface, Correction, tell
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.features import extractor_of
from sigmasplat.tracking.prepared_frame import view_of
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix, Progress, ShouldStop, never, no_progress
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty

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


class RealTime(ArrayInterface):
    """Runs a `Slam` on two clocks. `step` tracks a frame and returns; a mapping thread does everything else, and hands
    back snapshots of the map.

    Between `step` calls the state of `slam` belongs to the mapping thread: read it in a task (`between_frames`), or
    after `settle`. The results depend on how fast the machine is, so they are not reproducible. schedule: runs the work
    on the map; covariances: whether `track` and `covariance` return covariances, which cost some milliseconds of work
    per keyframe; should_stop: whether the next frame waits or is due soon, then no further guess of a doubtful pose is
    tried. Functions of `on_correction` are called by the thread that calls `step`, when it learns of the correction.
    """

    def __init__(
        self, slam: Slam, schedule: MappingThread | None = None, covariances: bool = True,
        should_stop: ShouldStop = never,
    ) -> None:  # fmt: skip
        self.slam, self._hurried, c = slam, should_stop, slam.config
        self._extractor = extractor_of(c)  # not shared with the mapping thread
        tracker = replace(Tracker.of(c, self._extractor), times=slam.sensor_times)
        self._front_end = FrontEnd(c, tracker, Recovery(c.recovery))
        self._snapshots: queue.SimpleQueue[Snapshot] = queue.SimpleQueue()
        self._back_end = BackEnd(slam, self._snapshots.put)
        self._back_end.with_errors = covariances
        self.listeners = slam.listeners
        self._newest, self._corrections = slam.newest_step(), list[Correction | None]()
        self._schedule = MappingThread() if schedule is None else schedule
        self._view: View | None = None
        self._runs, self._threads = False, 0
        # results, to be read after `settle`
        self.trajectory, self.valid, self.components = slam.trajectory, slam.valid, slam.components
        self.checkpoint = slam.checkpoint

    # ---- frames ----

    def step(self, frame: Frame) -> Step:
        """Track one frame and hand it to the map. Raises as `Slam.step`, and what the work on the map has raised."""
        timer = StepTimer()
        if self._view is None:
            self._view = self._start(frame)
        mapping_s = self._adopt()
        with timer.stage("prepare"):
            timer.start_kernels(self._view)
            seen = self.slam.observed(frame, self._view, self._extractor)
        if mapping_s:
            timer.add({"mapping": mapping_s})
        self._newest, tracked = self._front_end.track(seen, self._view, timer, self._hurried)
        self._give(tracked)
        self._schedule.wake()
        self._tell()
        return self._newest

    def _give(self, tracked: Iterable[TrackedFrame]) -> None:
        """Hand frames to the map."""
        for each in tracked:
            self._back_end.given.put(each)

    def _give_last(self) -> None:
        """Hand over the last frame, if it waits for the next one."""
        if self._view is not None:
            self._give(self._front_end.settled(self._front_end.tracker.motion.stopped(), self._view))

    def newest_step(self) -> Step | None:
        """Return the result of the newest frame; None before the first one."""
        return self._newest

    def covariance_of(self, newest: Step) -> Matrix | None:
        return self._front_end.covariance(newest) if self._back_end.with_errors else None

    def _start(self, frame: Frame) -> View:
        """Make the two views of the camera, and start the mapping thread."""
        camera = self.slam.view_for(frame).camera
        self._threads = set_kernel_threads(1)
        self._schedule.start(self._back_end.slices())
        self._runs = True
        return view_of(camera, self.slam.config)

    def _adopt(self) -> float:
        """Adopt the snapshots that have arrived; return the seconds of work that they contain."""
        mapping_s = 0.0
        while True:
            try:
                snapshot = self._snapshots.get_nowait()
            except queue.Empty:
                return mapping_s
            mapping_s += snapshot.seconds
            self._front_end.adopt(snapshot)
            self._corrections.append(snapshot.correction)

    def _tell(self) -> None:
        """Call the caller's functions for what has arrived."""
        arrived, self._corrections = self._corrections, []
        tell(self.listeners, arrived)

    @property
    def snapshot(self) -> Snapshot | None:
        """Return the snapshot that tracking uses; None before the first one."""
        return self._front_end.snapshot

    @property
    def keyframes_refused(self) -> int:
        """Return the number of frames that did not become keyframes because too many waited."""
        return self._front_end.refused

    # ---- between frames ----

    def between_frames(self, task: Callable[[], None]) -> None:
        """Run a task on the mapping thread as soon as all frames so far are in the map. It may read `slam`."""
        self._give_last()
        self._back_end.given.put(task)
        self._schedule.wake()

    def save(self, write: Callable[[], None]) -> None:
        """Run a task as `between_frames` does, with the whole state in `slam`, as after `Slam.step`."""
        self._give_last()
        camera = self._front_end.copied()

        def save() -> None:
            last = self._back_end.last  # it may follow others that were not adopted
            if last is not None and last is not camera.snapshot and last.frame in camera.poses:
                camera.adopt(last)
            self._give_back(camera)
            write()

        self.between_frames(save)

    def settle(self) -> None:
        """Finish the work on all frames so far, end the mapping thread, and put the whole state into `slam`. Raises
        what the work has raised."""
        if not self._runs:
            return
        self._runs = False
        self._give_last()
        try:
            self._schedule.wake()
            self._schedule.settle()
        finally:
            self._schedule.stop()
            set_kernel_threads(self._threads)
            self._adopt()
            self._give_back(self._front_end.copied())
        self.slam.settle()
        self._corrections.append(self._back_end.correction())  # the last frames may have closed loops
        self._tell()

    def _give_back(self, camera: FrontEnd) -> None:
        """Put the state of tracking into `slam`."""
        slam, tracker = self.slam, camera.tracker
        tracker.extractor = slam.tracker.extractor
        slam.tracker = tracker
        slam.recovery.lost, slam.recovery.steady = camera.recovery.lost, camera.recovery.steady

    # ---- results ----

    def finish(self, progress: Progress = no_progress) -> None:
        """Settle, and make the final map as `Slam.finish` does."""
        self.settle()
        self.slam.finish(progress)

    @property
    def loops(self) -> Loops:
        """Return every pair of submaps that was tried as a loop, as of the newest snapshot while frames arrive."""
        if self._runs:
            return Loops() if self._front_end.snapshot is None else self._front_end.snapshot.loops
        return self.slam.loops

    @property
    def field(self) -> GaussianField:
        """Return the map, as `Slam.field`, after `settle`."""
        return self.slam.field

    @property
    def sensor_times(self) -> SensorTimes:
        """Return when the sensor reads, as `Slam.sensor_times`, after `settle`."""
        return self.slam.sensor_times

    @property
    def uncertainty(self) -> MapUncertainty | None:
        """Return how sure the final map is, as `Slam.uncertainty`."""
        return self.slam.uncertainty

    @property
    def refinement_steps(self) -> int | None:
        """Return the number of refinement steps of the final map, as `Slam.refinement_steps`."""
        return self.slam.refinement_steps
