"""Keep a run's state now and then, so that one that was stopped, or killed, goes on where it was."""

import time
from dataclasses import dataclass, field

from sigmasplat.errors import RunError
from sigmasplat.io.atomic import write_text
from sigmasplat.io.json_files import read_text
from sigmasplat.io.runs import RunFolder
from sigmasplat.io.state import read_state, write_state
from sigmasplat.slam.slam import Slam
from sigmasplat.slam.state import CLASSES, fixed, restore, state_of
from sigmasplat.sources.base import Source


@dataclass(eq=False)
class Snapshots:
    """Writes state.safetensors into a run folder at most every `every_s` seconds; 0 = only where the frames end.

    A state is some tens of MB: the pictures of the active submap's keyframes.
    """

    slam: Slam
    run: RunFolder
    every_s: float = 0.0
    last_s: float = field(default_factory=time.perf_counter)

    def after_frame(self, index: int, wall_s: float) -> None:
        """Take note that source frame `index` is done, `wall_s` seconds into the run."""
        if self.every_s and time.perf_counter() - self.last_s >= self.every_s:
            self.keep(index, wall_s)

    def keep(self, index: int, wall_s: float) -> None:
        """Write the state after source frame `index`. Raises RunError if it cannot be written."""
        tree = state_of(self.slam) | {"index": index, "wall_s": wall_s}
        write_state(self.run.state, tree, CLASSES, fixed(self.slam))
        self.last_s = time.perf_counter()

    def drop(self) -> None:
        """Remove the state of a run that is complete."""
        self.run.state.unlink(missing_ok=True)


@dataclass(frozen=True)
class Begun:
    """Where a session begins: the source's next frame, and the seconds spent before."""

    slam: Slam
    next_index: int = 0
    wall_s: float = 0.0


def resume(run: RunFolder, source: Source) -> Begun:
    """Rebuild SLAM as it was when the run's state was kept, and take back what the run wrote after that.

    Raises RunError where the run is complete, or has no state, or other files than the state speaks of.
    """
    if run.facts().get("status") == "complete":
        raise RunError(f"{run.path} is complete; there is nothing to go on with (run --overwrite makes it anew)")
    config = run.config()
    slam = Slam(config, run.submaps)
    slam.prepare(source.camera.prepared(config.input.width, config.input.crop_px))
    tree = read_state(run.state, CLASSES, fixed(slam))
    _take_back(run, frames=len(tree["steps"]), submaps=tree["submaps"])
    restore(slam, tree)
    return Begun(slam, tree["index"] + 1, tree["wall_s"])


def _take_back(run: RunFolder, frames: int, submaps: int) -> None:
    """Drop what a run wrote after its first so many frames and submaps. Raises RunError if there are fewer."""
    log = run.path / "log.jsonl"
    lines = read_text(log).splitlines(keepends=True)
    if len(lines) < frames or len(run.submaps) < submaps:
        raise RunError(
            f"{run.path}: {len(lines)} frames in log.jsonl, {len(run.submaps)} submaps, "
            f"the state speaks of {frames} and {submaps}; run it again"
        )
    write_text(log, "".join(lines[:frames]))
    run.submaps.truncate(submaps)
