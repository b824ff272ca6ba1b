"""Save the state of a run from time to time, so that a stopped or killed run can resume where it left off."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from sigmasplat.errors import RunError
from sigmasplat.files.atomic import write_text
from sigmasplat.files.json_files import read_text
from sigmasplat.files.reading import guarded
from sigmasplat.input.source import Source
from sigmasplat.run.callbacks import run_now
from sigmasplat.run.same_conditions import refuse_other_sequence
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.slam.saved_state import CLASSES, fixed, restore, state_of
from sigmasplat.slam.slam import Slam

MOST_TIME_SHARE = 0.05
"""Maximum share of the run's time that is spent on saves: a state grows with the number of frames."""


@dataclass(eq=False)
class StateFile:
    """Writes state.safetensors into a run folder, at most every `every_s` seconds, and less often if a save takes long
    (`MOST_TIME_SHARE`).

    With every_s = 0 it writes only after the last frame. run_save: runs a save when the state belongs to the last
    frame; in real time that is later (`RealTime.save`). A state takes some tens of MB: it contains the images of the
    active submap's keyframes.
    """

    slam: Slam
    run: RunFolder
    every_s: float = 0.0
    run_save: Callable[[Callable[[], None]], None] = run_now
    last_s: float = field(default_factory=time.perf_counter)
    took_s: float = 0.0

    def after_frame(self, index: int, wall_s: float) -> None:
        """Save the state after source frame `index`, `wall_s` seconds into the run, if a save is due."""
        if self.every_s and time.perf_counter() >= self.last_s + max(self.every_s, self.took_s / MOST_TIME_SHARE):
            self.last_s = time.perf_counter()
            self.run_save(lambda: self.save(index, wall_s))

    def save(self, index: int, wall_s: float) -> None:
        """Write the state after source frame `index`. Raises RunError if it cannot be written."""
        started_s, tree = time.perf_counter(), state_of(self.slam) | {"index": index, "wall_s": wall_s}
        self.run.sync_log()  # the state needs these lines, also after a power failure
        write_state(self.run.state, tree, CLASSES, fixed(self.slam))
        self.slam.release()
        self.last_s = time.perf_counter()
        self.took_s = self.last_s - started_s

    def delete(self) -> None:
        """Delete the state of a complete run."""
        self.run.state.unlink(missing_ok=True)


@dataclass(frozen=True)
class StartPoint:
    """Where a session starts: the system, the index of the next source frame, and the seconds already spent."""

    slam: Slam
    next_index: int = 0
    wall_s: float = 0.0


def resume(run: RunFolder, source: Source) -> StartPoint:
    """Restore SLAM from the run's last saved state, and remove what the run wrote after it.

    Raises RunError if the run is complete, has no state, was made from another sequence, or has fewer files than its
    state requires.
    """
    if run.facts().get("status") == "complete":
        raise RunError(f"{run.path} is complete, so it cannot be resumed; to repeat it, use run --overwrite")
    refuse_other_sequence(run, source)
    run.remove_leftovers()
    config = run.config()
    slam = Slam(config, run.submaps.in_background())
    camera = source.camera.prepared(config.input.width, config.input.crop_px)
    onto = "onto" in run.facts() and len(run.submaps)
    slam.prepare(run.submaps.load(0).camera if onto else camera, resample=bool(onto))
    with guarded(run.state, "run it again", RunError, "the state is damaged"):
        tree = read_state(run.state, CLASSES, fixed(slam))
        restore(slam, tree)
        _truncate(run, frames=len(slam.steps), submaps=tree["submaps"])
    return StartPoint(slam, tree["index"] + 1, tree["wall_s"])


def _truncate(run: RunFolder, frames: int, submaps: int) -> None:
    """Keep only a run's first frames and submaps. Raises RunError if there are fewer."""
    log = run.path / "log.jsonl"
    lines = read_text(log).splitlines(keepends=True)
    if len(lines) < frames or len(run.submaps) < submaps:
        raise RunError(
            f"{run.path} has {len(lines)} frames in log.jsonl and {len(run.submaps)} submaps, "
            f"but its state needs {frames} and {submaps}; run it again"
        )
    write_text(log, "".join(lines[:frames]))
    run.submaps.truncate(submaps)
