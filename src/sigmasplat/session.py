"""Take a sequence through SLAM into a run folder that is valid however the run ends."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.io.runs import RunFolder
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.profile import profile
from sigmasplat.sources.base import Source


class Stepped(Protocol):
    """What a session reads of a step (slam.slam.Step)."""

    @property
    def index(self) -> int: ...
    @property
    def timestamp_s(self) -> float: ...
    @property
    def T_world_camera(self) -> NDArray[np.float64]: ...
    @property
    def is_keyframe(self) -> bool: ...
    @property
    def lost(self) -> bool: ...
    @property
    def tracking(self) -> Mapping[str, float]: ...
    @property
    def splats(self) -> int: ...
    @property
    def seconds(self) -> Mapping[str, float]: ...


class Stepper(Protocol):
    """What a session needs of a system (slam.slam.Slam)."""

    @property
    def field(self) -> GaussianField: ...
    def step(self, frame: Frame) -> Stepped: ...
    def trajectory(self) -> Trajectory: ...
    def checkpoint(self) -> dict[str, Tensor]: ...


RUNS = Path("runs")


def new_folder(out: Path | None, config: Config, source: Source, overwrite: bool = False, **facts: Any) -> RunFolder:
    """Start a run folder and note facts in its run.json; without `out` it is runs/SOURCE-PRESET, numbered where taken.

    Raises RunError if it cannot be written, or holds something and may not be overwritten.
    """
    plain_name = "".join(c if c.isalnum() or c in "._-" else "-" for c in source.name).strip("-.") or "run"
    default = RUNS / f"{plain_name}-{config.name}"
    folder = RunFolder.create(out or (default if overwrite else _free(default)), config, source.name, overwrite)
    folder.note(**facts)
    return folder


def _free(wanted: Path) -> Path:
    """Return the path itself, or with -2, -3, … the first that holds nothing."""
    taken, number = wanted, 1
    while taken.exists() and not (taken.is_dir() and not any(taken.iterdir())):
        number += 1
        taken = wanted.with_name(f"{wanted.name}-{number}")
    return taken


@dataclass(frozen=True)
class Outcome:
    """How a session ended: status complete or interrupted; wall_s covers the frames, not the writing of the results."""

    status: str
    frames: int
    lost: int
    wall_s: float


def record(
    slam: Stepper, source: Source, run: RunFolder, watch: Callable[[Stepped], None] = lambda step: None
) -> Outcome:
    """Track and map every frame, a log line each; then write trajectory, map and checkpoint, also where cut short.

    The first Ctrl-C ends the session after the frame in work, a second one at once; both end as "interrupted". Any
    other exception leaves the same files, marks the run "failed", and carries the run folder's path in a note.
    """
    tally = _Tally(time.perf_counter())
    status = "failed"
    try:
        with interrupt_asked() as asked:
            status = _follow(slam, source, run, watch, tally, asked)
    except KeyboardInterrupt:
        status = "interrupted"
    except Exception as problem:
        problem.add_note(f"the run up to frame {tally.frames} is in {run.path}")
        raise
    finally:
        wall_s = time.perf_counter() - tally.started_s
        _save(slam, run, tally.frames, wall_s)
        run.note(status=status, wall_s=wall_s, skipped=source.skipped)
    return Outcome(status, tally.frames, tally.lost, wall_s)


@dataclass
class _Tally:
    started_s: float
    frames: int = 0
    lost: int = 0


def _follow(
    slam: Stepper,
    source: Source,
    run: RunFolder,
    watch: Callable[[Stepped], None],
    tally: _Tally,
    asked: threading.Event,
) -> str:
    """Step through the frames until they end or Ctrl-C asked to stop; return the status."""
    for frame in source:
        step = slam.step(frame)
        run.log(log_line(step))
        tally.frames += 1
        tally.lost += step.lost
        watch(step)
        if asked.is_set():
            return "interrupted"
    return "complete"


def log_line(step: Stepped) -> dict[str, Any]:
    """Return a step as the record of log.jsonl: T_world_camera as 4 rows, times in seconds."""
    return {
        "index": step.index,
        "timestamp_s": step.timestamp_s,
        "is_keyframe": step.is_keyframe,
        "lost": step.lost,
        "splats": step.splats,
        "tracking": dict(step.tracking),
        "seconds": dict(step.seconds),
        "T_world_camera": step.T_world_camera,
    }


def _save(slam: Stepper, run: RunFolder, frames: int, wall_s: float) -> None:
    """Write what the frames so far have made."""
    if frames == 0:
        return
    run.write_trajectory(slam.trajectory())
    run.write_map(slam.field)
    run.write_checkpoint(slam.checkpoint(), {"frames": str(frames)})
    run.write_profile(profile(run.read_log(), wall_s))


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
