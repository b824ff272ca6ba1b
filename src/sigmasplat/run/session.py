"""Run SLAM on a sequence and keep the results in a run folder that stays readable however the run ends.

The order: create the run folder; for each frame take a step, append a line to the log, call the callbacks, and
sometimes save the state; make the final map; write the results. The command (`commands/run.py`) opens the source before
that and scores the run afterwards.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import InitVar, dataclass, field
from functools import partial
from operator import call
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmasplat.config import Config
from sigmasplat.data.camera_errors import CameraErrors, sensor_said
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import RELOCALISED
from sigmasplat.errors import RunError
from sigmasplat.files.lock import LOCK, locked, no_warning
from sigmasplat.input.source import Source
from sigmasplat.run.callbacks import Callback, interrupt_event
from sigmasplat.run.same_conditions import start_facts
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import RunFolder

if TYPE_CHECKING:
    from sigmasplat.realtime.system import RealTime
    from sigmasplat.run.resume import StateFile
    from sigmasplat.slam.results import Step
    from sigmasplat.system.slam import Slam

RUNS = Path("runs")


def new_folder(out: Path | None, config: Config, source: Source, overwrite: bool = False, **facts: Any) -> RunFolder:
    """Create a run folder as `new_run` does, without its lock."""
    with new_run(out, config, source, overwrite, **facts) as folder:
        return folder


@contextmanager
def new_run(
    out: Path | None, config: Config, source: Source, overwrite: bool = False, keep: Path | None = None,
    warn: Callable[[str], None] = no_warning, **facts: Any,
) -> Iterator[RunFolder]:  # fmt: skip
    """Yield a new run folder, whose run.json has facts, and hold its lock during the block (`files.lock`).

    The default is runs/SOURCE-PRESET, numbered if it exists. keep: a run that must not be overwritten. A folder without
    results is removed if the block fails. Raises RunError if the folder cannot be written, is `keep`, is in use by
    another process, or is not empty and may not be overwritten.
    """
    plain_name = "".join(c if c.isalnum() or c in "._-" else "-" for c in source.name).strip("-.") or "run"
    default = RUNS / f"{plain_name}-{config.name}"
    path = out or (default if overwrite else unused_path(default))
    if keep and path.resolve() == keep.resolve():
        raise RunError(f"output {path} is the run that --onto continues, which is never changed; give another --out")
    RunFolder.refuse_taken(path, overwrite)
    with locked(path, warn):
        folder = RunFolder.create(path, config, source.name, overwrite)
        folder.note(**start_facts(source) | facts)
        try:
            yield folder
        except BaseException:
            _remove_without_results(folder)
            raise


def unused_path(wanted: Path) -> Path:
    """Return the path itself, or the first of path-2, path-3, … that does not exist or is an empty folder."""
    path, number = wanted, 1
    while path.exists() and not (path.is_dir() and not any(path.iterdir())):
        number += 1
        path = wanted.with_name(f"{wanted.name}-{number}")
    return path


def _remove_without_results(run: RunFolder) -> None:
    """Remove a new run folder unless it holds a log, a recording or a file of the user's.

    An empty runs/ is removed too. Submaps that were copied from an earlier run are removed.
    """
    # run.json goes last: it marks the folder as ours, so that after a kill in between --overwrite still accepts it.
    written_first, lock = [run.path / "config.json", run.path / "run.json"], run.path / LOCK
    copied = {run.submaps.folder, *run.submaps.folder.glob("*")}
    if {*run.path.rglob("*")} <= {lock, *written_first, *copied}:
        run.submaps.clear()
        for file in (*written_first, lock):
            file.unlink(missing_ok=True)
        for folder in (run.path, RUNS):
            with suppress(OSError):
                folder.rmdir()


@dataclass
class Outcome:
    """How a session ended: "complete", "interrupted" or "failed", and its counts.

    wall_s: seconds of the frames, without the final map; apart: the number of frames of each component that is not
    connected to the world.
    """

    status: str = "failed"
    frames: int = 0
    lost: int = 0
    wall_s: float = 0.0
    submaps: int = 1
    loops_closed: int = 0
    loops_refused: int = 0
    relocalised: int = 0
    apart: tuple[int, ...] = ()
    sensor: str = ""

    def count(self, lost: bool, state: str, submap: int) -> None:
        """Count a frame."""
        self.frames += 1
        self.lost += lost
        self.relocalised += state == RELOCALISED
        self.submaps = submap + 1

    def summary(self) -> str:
        """Return the counts as text."""
        line = f"{self.frames} frames, {self.lost} lost"
        if self.relocalised:
            line += f", {self.relocalised} relocalised"
        if self.apart:
            line += f", {len(self.apart)} component{'s' * (len(self.apart) != 1)} apart ({sum(self.apart)} frames)"
        line += f", {self.frames / self.wall_s:.1f} frames/s"
        if self.submaps > 1:
            line += f", {self.submaps} submaps, loops: {self.loops_closed} closed, {self.loops_refused} refused"
        return line + f"; {self.sensor}" * bool(self.sensor)


@dataclass(eq=False)
class Session:
    """A run of SLAM on a source, from its frame `first_index` on; a resumed run has already taken `wall_s` seconds.

    callbacks: called after each step and with the progress of the end; readers: called too, but `later`, because they
    read the system and not only the step. watch: gets each frame before its step. later: runs a task that no frame
    needs to wait for; at once by default, beside the frames in real time.
    """

    slam: "Slam | RealTime"
    source: Source
    run: RunFolder
    callbacks: Sequence[Callback] = ()
    state: "StateFile | None" = None
    first_index: int = 0
    wall_s: InitVar[float] = 0.0
    readers: Sequence[Callback] = ()
    watch: Callable[[Frame], object] | None = None
    later: Callable[[Callable[[], None]], None] = call
    outcome: Outcome = field(init=False)

    def __post_init__(self, wall_s: float) -> None:
        self.outcome = Outcome(wall_s=wall_s)

    def execute(self) -> Outcome:
        """Process all frames, make the final map, and write trajectory, map, loops and checkpoint.

        The results are also written if the session is interrupted. The first Ctrl-C stops after the current frame, or
        at the next progress report of the final map; a second one stops immediately. Both end as "interrupted", and a
        session interrupted between frames makes no final map. A live source ends only with Ctrl-C: the first one ends
        its frames, and the final map is made. SIGTERM and SIGHUP do the same as Ctrl-C. Any other exception marks the
        run as "failed" and gets a note with the path of the run folder. Raises RunError if another process holds it.
        """
        with self.run.locked():
            return self._execute()

    def _execute(self) -> Outcome:
        outcome = self.outcome
        if self.first_index:
            for line in self.run.read_log():
                outcome.count(line["lost"], line.get("state", ""), line["submap"])
        try:
            with interrupt_event() as interrupt:
                complete = self._process_frames(interrupt)
                if complete:
                    self._finish(interrupt)
                outcome.status = "complete" if complete else "interrupted"
        except KeyboardInterrupt:
            outcome.status = "interrupted"
        except Exception as problem:
            if outcome.frames:
                problem.add_note(f"the run up to frame {outcome.frames} is in {self.run.path}")
            raise
        finally:
            self._end(outcome.status)
        if self.state and outcome.status == "complete":
            self.state.delete()
        outcome.loops_closed = sum(loop.accepted for loop in self.slam.loops)
        outcome.loops_refused = len(self.slam.loops) - outcome.loops_closed
        return outcome

    def _end(self, status: str) -> None:
        """Write the results and the status.

        The status is "interrupted" (or "failed") until the results are complete, and stays so if they cannot be
        written: the run can be resumed.
        """
        dropped = {} if self.source.arrived_s is None else {"dropped": self.source.dropped}
        ending = {"wall_s": self.outcome.wall_s, "skipped": self.source.skipped, **dropped}
        self.run.note(status="failed" if status == "failed" else "interrupted", **ending)
        try:
            self._write_results()
        except BaseException as problem:
            self.run.note(status="interrupted" if isinstance(problem, KeyboardInterrupt) else "failed")
            raise
        self.run.note(status=status)

    def _process_frames(self, interrupt: threading.Event) -> bool:
        """Step through the frames until they end or Ctrl-C stops them; return whether all frames were processed."""
        outcome, frame, began_s = self.outcome, None, time.perf_counter() - self.outcome.wall_s
        try:
            for frame in self.source.frames_from(self.first_index):
                if self.watch:
                    self.watch(frame)
                step = self.slam.step(frame)
                self._log(step, frame, self.source.arrived_s)
                outcome.wall_s = time.perf_counter() - began_s
                for callback in self.callbacks:
                    callback(step)
                for reader in self.readers:
                    self.later(partial(reader, step))
                if self.state:
                    self.state.after_frame(frame.index, outcome.wall_s)
                if interrupt.is_set():
                    break
        finally:
            outcome.wall_s = time.perf_counter() - began_s
            self.slam.settle()
        if self.state and frame is not None:
            self.state.save(frame.index, outcome.wall_s)
        if self.source.live:
            interrupt.clear()  # this Ctrl-C has ended the live frames; the next one interrupts the final map
        return not interrupt.is_set()

    def _log(self, step: "Step", frame: Frame, arrived_s: float | None) -> None:
        """Append the step to log.jsonl, with the force on the camera and the time since the image arrived if they are
        known, and count the frame."""
        line = {name: getattr(step, name) for name in LOGGED} | {"seconds": dict(step.seconds)}
        line |= {"diagnosis": step.diagnosis} if step.lost else {}
        if step.loops:
            line["loops"] = [loop.record() for loop in step.loops]
        if frame.specific_force_m_s2 is not None:
            line["specific_force_m_s2"] = frame.specific_force_m_s2
        if arrived_s is not None:
            line["seconds"]["latency"] = time.perf_counter() - arrived_s
        self.run.log(line)
        self.outcome.count(step.lost, step.state, step.submap)

    def _finish(self, interrupt: threading.Event) -> None:
        """Make the final map and write how long it took. Raises KeyboardInterrupt after Ctrl-C."""

        def progress(done: int, total: int) -> None:
            for callback in (*self.callbacks, *self.readers):
                callback.finishing(done, total)
            if interrupt.is_set():
                raise KeyboardInterrupt

        before, started_s = len(self.slam.loops), time.perf_counter()
        self.slam.finish(progress)
        self.run.note(finish_s=time.perf_counter() - started_s, final_steps=self.slam.refinement_steps)
        camera = CameraErrors.given(self.run.config().input.calibrate)
        self.run.note(**(noted := self.slam.sensor_times.noted() | camera.noted()))
        self.outcome.sensor = sensor_said(noted)
        for callback in (*self.callbacks, *self.readers):
            callback.last_loops(self.slam.loops[before:])

    def _write_results(self) -> None:
        """Write the results of the frames so far. The maps are the last files because they take longest."""
        if self.outcome.frames == 0:
            return
        self.run.sync_log()
        path, components = self.slam.trajectory(), self.slam.components()
        self.outcome.apart = tuple(len(component.trajectory) for component in components)
        valid = path.at(self.slam.valid())
        self.run.write_trajectory(valid)
        self.run.write_loops(loop.record() for loop in self.slam.loops)
        self.run.write_checkpoint(self.slam.checkpoint(), {"frames": str(self.outcome.frames)})
        if (up := RunFrames.of(self.run.read_log(), valid).measured_up()) is not None:
            self.run.note(up_world=up.tolist())
        self.run.write_components(components)
        self.run.write_map(self.slam.field)
        if self.slam.uncertainty is not None:
            self.run.write_uncertainty(self.slam.uncertainty)


LOGGED = (
    "index", "timestamp_s", "is_keyframe", "lost", "state", "component", "p_off", "splats", "submap", "tracking",
    "seconds", "T_world_camera",
)  # fmt: skip
"""The values of a step in log.jsonl: T_world_camera as 4 rows, times in seconds; diagnosis and loops follow if any."""
