"""Run SLAM on a sequence and keep the results in a run folder that stays readable however the run ends.

The order: create the run folder; for each frame take a step, append a line to the log, call the callback, and sometimes
write a checkpoint; make the final map; write the results. The command (`commands/run.py`) opens the source before that
and scores the run afterwards.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmasplat.config import Config
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import RELOCALISED
from sigmasplat.errors import RunError
from sigmasplat.files.lock import LOCK, locked, no_warning
from sigmasplat.input.source import Source
from sigmasplat.run.callbacks import Callback, Checkpointer
from sigmasplat.run.figures import profile
from sigmasplat.run.same_conditions import start_facts
from sigmasplat.run.signals import interrupt_event
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import ALL_POSES, RunFolder

if TYPE_CHECKING:
    from sigmasplat.realtime.system import RealTime
    from sigmasplat.slam.results import Step
    from sigmasplat.slam.slam import Slam

RUNS = Path("runs")
LOOPS_GROWTH = 1.05
"""loops.json is written when the number of loops has grown by this factor: a long run writes a loop about 20 times."""


def new_folder(
    out: Path | None, config: Config, source: Source, overwrite: bool = False, keep: Path | None = None, **facts: Any
) -> RunFolder:
    """Create a run folder and write facts to its run.json; the default is runs/SOURCE-PRESET, numbered if it exists.

    keep: a run that must not be overwritten. Raises RunError if the folder cannot be written, is `keep`, is in use by
    another process, or is not empty and may not be overwritten.
    """
    path = _new_path(out, config, source, overwrite, keep)
    with locked(path):
        return _created(path, config, source, overwrite, facts)


@contextmanager
def new_run(
    out: Path | None,
    config: Config,
    source: Source,
    overwrite: bool = False,
    keep: Path | None = None,
    warn: Callable[[str], None] = no_warning,
    **facts: Any,
) -> Iterator[RunFolder]:
    """Yield a new run folder as `new_folder` does, and hold its lock during the block (`files.lock`).

    A folder without results is removed if the block fails (`removed_on_early_failure`). Raises as `new_folder`.
    """
    path = _new_path(out, config, source, overwrite, keep)
    with locked(path, warn):
        folder = _created(path, config, source, overwrite, facts)
        with removed_on_early_failure(folder):
            yield folder


def _new_path(out: Path | None, config: Config, source: Source, overwrite: bool, keep: Path | None) -> Path:
    """Return the path of a new run folder. Raises RunError if it is `keep`, or may not be written."""
    plain_name = "".join(c if c.isalnum() or c in "._-" else "-" for c in source.name).strip("-.") or "run"
    default = RUNS / f"{plain_name}-{config.name}"
    path = out or (default if overwrite else unused_path(default))
    if keep and path.resolve() == keep.resolve():
        raise RunError(f"output {path} is the run that --onto continues, which is never changed; give another --out")
    RunFolder.refuse_taken(path, overwrite)
    return path


def _created(path: Path, config: Config, source: Source, overwrite: bool, facts: dict[str, Any]) -> RunFolder:
    facts = start_facts(source) | facts
    folder = RunFolder.create(path, config, source.name, overwrite)
    folder.note(**facts)
    return folder


def unused_path(wanted: Path) -> Path:
    """Return the path itself, or the first of path-2, path-3, … that does not exist or is an empty folder."""
    path, number = wanted, 1
    while path.exists() and not (path.is_dir() and not any(path.iterdir())):
        number += 1
        path = wanted.with_name(f"{wanted.name}-{number}")
    return path


@contextmanager
def removed_on_early_failure(run: RunFolder) -> Iterator[None]:
    """Remove a new run folder if the block fails before the run has results.

    The folder stays if it holds a log, a recording or a file of the user's. An empty runs/ is removed too. Submaps that
    were copied from an earlier run are removed.
    """
    try:
        yield
    except BaseException:
        # run.json goes last: it marks the folder as ours, so that after a kill in between --overwrite still accepts it.
        written_first = [run.path / "config.json", run.path / "run.json"]
        copied = {run.submaps.folder, *run.submaps.folder.glob("*")}
        lock = run.path / LOCK
        if {*run.path.rglob("*")} <= {run.images, lock, *written_first, *copied}:
            run.submaps.clear()
            for file in (*written_first, lock):
                file.unlink(missing_ok=True)
            for folder in (run.images, run.path, RUNS):
                with suppress(OSError):
                    folder.rmdir()
        raise


@dataclass(frozen=True)
class Outcome:
    """How a session ended: "complete" or "interrupted", and its counts. wall_s covers the frames, not the final map.

    apart: the number of frames of each component that is not connected to the world.
    """

    status: str
    frames: int
    lost: int
    wall_s: float
    submaps: int = 1
    loops_closed: int = 0
    loops_refused: int = 0
    relocalised: int = 0
    apart: tuple[int, ...] = ()

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
        return line


def ignore(frame: Frame) -> None:
    """Do nothing with a frame."""


def run_now(task: Callable[[], None]) -> None:
    """Run a task at once."""
    task()


@dataclass(eq=False)
class Session:
    """A run of SLAM on a source, from its frame `first_index` on; a resumed run has already taken `wall_s` seconds.

    all_poses: also write trajectory_all.txt, which has the poses of all frames. watch: gets each frame before its step.
    later: runs a task that no frame needs to wait for; at once by default, beside the frames in real time.
    """

    slam: "Slam | RealTime"
    source: Source
    run: RunFolder
    callback: Callback = field(default_factory=Callback)
    checkpointer: Checkpointer = field(default_factory=Checkpointer)
    first_index: int = 0
    wall_s: float = 0.0
    all_poses: bool = False
    watch: Callable[[Frame], None] = ignore
    later: Callable[[Callable[[], None]], None] = run_now
    frames: int = field(default=0, init=False)
    lost: int = field(default=0, init=False)
    relocalised: int = field(default=0, init=False)
    apart: tuple[int, ...] = field(default=(), init=False)
    submaps: int = field(default=1, init=False)
    loops_written: int = field(default=0, init=False)

    def execute(self) -> Outcome:
        """Process all frames, make the final map, and write trajectory, map, loops and checkpoint.

        The results are also written if the session is interrupted. The first Ctrl-C stops after the current frame, or
        at the next progress report of the final map; a second one stops immediately. Both end as "interrupted", and a
        session interrupted between frames makes no final map. A live source ends only with Ctrl-C: the first one ends
        its frames, and the final map is made. SIGTERM and SIGHUP do the same as Ctrl-C. Any other exception marks the
        run as "failed" and gets a note with the path of the run folder. Raises RunError if another process holds the
        run folder.
        """
        with self.run.locked():
            return self._execute()

    def _execute(self) -> Outcome:
        if self.first_index:
            self._count_earlier_frames()
        status = "failed"
        try:
            with interrupt_event() as interrupt:
                complete = self._process_frames(interrupt)
                if complete:
                    self._finish(interrupt)
                status = "complete" if complete else "interrupted"
        except KeyboardInterrupt:
            status = "interrupted"
        except Exception as problem:
            if self.frames:
                problem.add_note(f"the run up to frame {self.frames} is in {self.run.path}")
            raise
        finally:
            self._end(status)
        if status == "complete":
            self.checkpointer.delete()
        return self._outcome(status)

    def _end(self, status: str) -> None:
        """Write the results and the status.

        The status is "interrupted" (or "failed") until the results are complete, and stays so if they cannot be
        written: the run can be resumed.
        """
        dropped = {} if self.source.arrived_s is None else {"dropped": self.source.dropped}
        ending = {"wall_s": self.wall_s, "skipped": self.source.skipped, **dropped}
        self.run.note(status="failed" if status == "failed" else "interrupted", **ending)
        try:
            self._write_results()
        except BaseException as problem:
            self.run.note(status="interrupted" if isinstance(problem, KeyboardInterrupt) else "failed")
            raise
        self.run.note(status=status)

    def _count_earlier_frames(self) -> None:
        """Restore the counts of a resumed run from its log."""
        log = self.run.read_log()
        self.frames, self.lost = len(log), sum(line["lost"] for line in log)
        self.relocalised = sum(line.get("state") == RELOCALISED for line in log)
        self.submaps = 1 + (log[-1]["submap"] if log else 0)

    def _process_frames(self, interrupt: threading.Event) -> bool:
        """Step through the frames until they end or Ctrl-C stops them; return whether all frames were processed."""
        earlier_s, started_s, frame = self.wall_s, time.perf_counter(), None
        try:
            for frame in self.source.frames_from(self.first_index):
                self.watch(frame)
                step = self.slam.step(frame)
                self._log(step, frame, self.source.arrived_s)
                self.wall_s = earlier_s + time.perf_counter() - started_s
                self.callback(step)
                self.checkpointer.after_frame(frame.index, self.wall_s)
                if interrupt.is_set():
                    break
        finally:
            self.wall_s = earlier_s + time.perf_counter() - started_s
            self.slam.settle()
        if frame is not None:
            self.checkpointer.save(frame.index, self.wall_s)
        if self.source.live:
            interrupt.clear()  # this Ctrl-C has ended the live frames; the next one interrupts the final map
        return not interrupt.is_set()

    def _log(self, step: "Step", frame: Frame, arrived_s: float | None) -> None:
        """Append the step to log.jsonl, with the force on the camera and the time since the image arrived if they are
        known; update loops.json if enough loops were tried since it was written, and count the frame."""
        line = log_line(step)
        if frame.specific_force_m_s2 is not None:
            line["specific_force_m_s2"] = frame.specific_force_m_s2
        if arrived_s is not None:
            line["seconds"]["latency"] = time.perf_counter() - arrived_s
        self.run.log(line)
        if step.loops and len(self.slam.loops) >= LOOPS_GROWTH * self.loops_written:
            self.later(self._write_loops)
        self.frames += 1
        self.lost += step.lost
        self.relocalised += step.state == RELOCALISED
        self.submaps = step.submap + 1

    def _finish(self, interrupt: threading.Event) -> None:
        """Make the final map and write how long it took. Raises KeyboardInterrupt after Ctrl-C."""

        def progress(done: int, total: int) -> None:
            self.callback.finishing(done, total)
            if interrupt.is_set():
                raise KeyboardInterrupt

        before, started_s = len(self.slam.loops), time.perf_counter()
        self.slam.finish(progress)
        self.run.note(finish_s=time.perf_counter() - started_s, final_steps=self.slam.refinement_steps)
        self.callback.last_loops(self.slam.loops[before:])

    def _write_results(self) -> None:
        """Write the results of the frames so far. The maps are the last files because they take longest."""
        if self.frames == 0:
            return
        self.run.sync_log()
        path, components = self.slam.trajectory(), self.slam.components()
        self.apart = tuple(len(component.trajectory) for component in components)
        valid = path.at(self.slam.valid())
        self.run.write_trajectory(valid)
        if self.all_poses or (self.run.path / ALL_POSES).exists():
            self.run.write_all_poses(path)
        self._write_loops()
        self.run.write_checkpoint(self.slam.checkpoint(), {"frames": str(self.frames)})
        log = self.run.read_log()
        self.run.write_profile(profile(log, self.wall_s))
        if (up := RunFrames.of(log, valid).measured_up()) is not None:
            self.run.note(up_world=up.tolist())
        self.run.write_components(components)
        self.run.write_map(self.slam.field)
        if self.slam.uncertainty is not None:
            self.run.write_uncertainty(self.slam.uncertainty)

    def _write_loops(self) -> None:
        loops = self.slam.loops
        self.loops_written = len(loops)
        self.run.write_loops(loop.record() for loop in loops)

    def _outcome(self, status: str) -> Outcome:
        closed = sum(loop.accepted for loop in self.slam.loops)
        refused = len(self.slam.loops) - closed
        counts = self.submaps, closed, refused, self.relocalised, self.apart
        return Outcome(status, self.frames, self.lost, self.wall_s, *counts)


def log_line(step: "Step") -> dict[str, Any]:
    """Return a step as a record of log.jsonl: T_world_camera as 4 rows, times in seconds, loops if any were tried."""
    line = {
        "index": step.index,
        "timestamp_s": step.timestamp_s,
        "is_keyframe": step.is_keyframe,
        "lost": step.lost,
        "state": step.state,
        "component": step.component,
        "p_off": step.p_off,
        "splats": step.splats,
        "submap": step.submap,
        "tracking": dict(step.tracking),
        "seconds": dict(step.seconds),
        "T_world_camera": step.T_world_camera,
    }
    return line | {"loops": [loop.record() for loop in step.loops]} if step.loops else line
