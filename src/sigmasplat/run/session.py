"""Take a sequence through SLAM into a run folder that is valid however the run ends."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from sigmasplat.config import Config
from sigmasplat.io.runs import RunFolder
from sigmasplat.run.profile import profile
from sigmasplat.run.protocols import Callback, NullCallback, SlamSystem, StepResult
from sigmasplat.sources.base import Source

RUNS = Path("runs")


def new_folder(out: Path | None, config: Config, source: Source, overwrite: bool = False, **facts: Any) -> RunFolder:
    """Start a run folder and note facts in its run.json; without `out` it is runs/SOURCE-PRESET, numbered where taken.

    Raises RunError if it cannot be written, or holds something and may not be overwritten.
    """
    plain_name = "".join(c if c.isalnum() or c in "._-" else "-" for c in source.name).strip("-.") or "run"
    default = RUNS / f"{plain_name}-{config.name}"
    folder = RunFolder.create(out or (default if overwrite else free(default)), config, source.name, overwrite)
    folder.note(**facts)
    return folder


def free(wanted: Path) -> Path:
    """Return the path itself, or with -2, -3, … the first that holds nothing."""
    taken, number = wanted, 1
    while taken.exists() and not (taken.is_dir() and not any(taken.iterdir())):
        number += 1
        taken = wanted.with_name(f"{wanted.name}-{number}")
    return taken


@dataclass(frozen=True)
class Outcome:
    """How a session ended: status complete or interrupted; wall_s covers the frames, not what is done after them."""

    status: str
    frames: int
    lost: int
    wall_s: float
    submaps: int = 1
    loops_closed: int = 0
    loops_refused: int = 0

    def counts(self) -> str:
        """Say in words what was done."""
        line = f"{self.frames} frames, {self.lost} lost, {self.frames / self.wall_s:.1f} frames/s"
        if self.submaps > 1:
            line += f", {self.submaps} submaps, loops: {self.loops_closed} closed, {self.loops_refused} refused"
        return line


class Checkpointer(Protocol):
    """Keeps what a run needs to go on after a stop (snapshots.Snapshots)."""

    def after_frame(self, index: int, wall_s: float) -> None: ...
    def keep(self, index: int, wall_s: float) -> None: ...
    def drop(self) -> None: ...


def record(
    slam: SlamSystem,
    source: Source,
    run: RunFolder,
    watch: Callback | None = None,
    keeper: Checkpointer | None = None,
    first: int = 0,
    spent_s: float = 0.0,
) -> Outcome:
    """Track and map every frame, a log line each, and finish; then write trajectory, map, loops and checkpoint.

    A session that goes on begins at the source's frame `first`, `spent_s` seconds having been spent before.

    These are written also where the session is cut short. The first Ctrl-C ends it after the frame in work, or where
    finishing next tells how far it is; a second one at once: all end as "interrupted", and frames cut short are not
    finished. A live sequence has no other end: there the first Ctrl-C ends the frames, and they are finished. Any other
    exception leaves the same files, marks the run "failed", and carries the run folder's path in a note.
    """
    tally, watch, keeper = _Tally.of(run, first, spent_s), watch or NullCallback(), keeper or _Unkept()
    status = "failed"
    try:
        with interrupt_asked() as asked:
            complete = _follow(slam, source, run, watch, keeper, tally, asked)
            if complete:
                _finish(slam, run, watch, asked)
            status = "complete" if complete else "interrupted"
    except KeyboardInterrupt:
        status = "interrupted"
    except Exception as problem:
        if tally.frames:
            problem.add_note(f"the run up to frame {tally.frames} is in {run.path}")
        raise
    finally:
        _save(slam, run, tally)
        run.note(status=status, wall_s=tally.wall_s, skipped=source.skipped)
    if status == "complete":
        keeper.drop()
    closed = sum(loop.accepted for loop in slam.loops)
    return Outcome(
        status, tally.frames, tally.lost, tally.wall_s, tally.submaps, closed, len(slam.loops) - closed
    )  # fmt: skip


@dataclass
class _Tally:
    frames: int = 0
    lost: int = 0
    submaps: int = 1
    wall_s: float = 0.0
    first: int = 0

    @staticmethod
    def of(run: RunFolder, first: int, spent_s: float) -> "_Tally":
        """Begin where an earlier session of the run stopped."""
        log = run.read_log() if first else []
        lost, submaps = sum(line["lost"] for line in log), 1 + (log[-1]["submap"] if log else 0)
        return _Tally(len(log), lost, submaps, spent_s, first)


class _Unkept:
    def after_frame(self, index: int, wall_s: float) -> None: ...
    def keep(self, index: int, wall_s: float) -> None: ...
    def drop(self) -> None: ...


def _follow(
    slam: SlamSystem,
    source: Source,
    run: RunFolder,
    watch: Callback,
    keeper: Checkpointer,
    tally: _Tally,
    asked: threading.Event,
) -> bool:
    """Step through the frames until they end or Ctrl-C asked to stop; return whether it was the frames that ended."""
    started_s, spent_s, frame = time.perf_counter(), tally.wall_s, None
    try:
        for frame in source.frames_from(tally.first):
            step = slam.step(frame)
            run.log(log_line(step))
            if step.loops:
                _write_loops(slam, run)
            tally.frames += 1
            tally.lost += step.lost
            tally.submaps = step.submap + 1
            tally.wall_s = spent_s + time.perf_counter() - started_s
            watch(step)
            keeper.after_frame(frame.index, tally.wall_s)
            if asked.is_set():
                break
    finally:
        tally.wall_s = spent_s + time.perf_counter() - started_s
    if frame is not None:
        keeper.keep(frame.index, tally.wall_s)
    if source.live:
        asked.clear()  # Ctrl-C is how a live sequence ends; the next one cuts its finishing short
    return not asked.is_set()


def _finish(slam: SlamSystem, run: RunFolder, watch: Callback, asked: threading.Event) -> None:
    """Make the final map and note how long it took. Raises KeyboardInterrupt if Ctrl-C asks to stop."""

    def progress(done: int, total: int) -> None:
        watch.finishing(done, total)
        if asked.is_set():
            raise KeyboardInterrupt

    before, started_s = len(slam.loops), time.perf_counter()
    slam.finish(progress)
    run.note(finish_s=time.perf_counter() - started_s)
    watch.last_loops(slam.loops[before:])


def log_line(step: StepResult) -> dict[str, Any]:
    """Return a step as the record of log.jsonl: T_world_camera as 4 rows, times in seconds; loops if any were tried."""
    line = {
        "index": step.index,
        "timestamp_s": step.timestamp_s,
        "is_keyframe": step.is_keyframe,
        "lost": step.lost,
        "splats": step.splats,
        "submap": step.submap,
        "tracking": dict(step.tracking),
        "seconds": dict(step.seconds),
        "T_world_camera": step.T_world_camera,
    }
    return line | {"loops": [loop.record() for loop in step.loops]} if step.loops else line


def _save(slam: SlamSystem, run: RunFolder, tally: _Tally) -> None:
    """Write what the frames so far have made, the map last: it takes longest."""
    if tally.frames == 0:
        return
    run.write_trajectory(slam.trajectory())
    _write_loops(slam, run)
    run.write_checkpoint(slam.checkpoint(), {"frames": str(tally.frames)})
    run.write_profile(profile(run.read_log(), tally.wall_s))
    run.write_map(slam.field)


def _write_loops(slam: SlamSystem, run: RunFolder) -> None:
    run.write_loops([loop.record() for loop in slam.loops])


@contextmanager
def interrupt_asked() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into an event, so that no step is cut in half; the next one acts as ever.

    Outside the main thread, where signals cannot be handled, the event is never set.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(signum: int, frame: FrameType | None) -> None:
        asked.set()
        signal.signal(signal.SIGINT, earlier)

    earlier = signal.signal(signal.SIGINT, ask)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, earlier)
