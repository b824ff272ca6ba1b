"""Save the state of a run from time to time, so that a stopped or killed run can resume where it left off: the state
of SLAM between two frames as one tree."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import call
from typing import Any

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.frame import Detail, Frame, Photo, PosePrior
from sigmasplat.data.poses import Column, KeyframePoses, Places, Poses
from sigmasplat.data.readout import Readout, Readouts, SensorTimes
from sigmasplat.data.relative_pose import Alignments, Edges, RelativePose, TrackedHops
from sigmasplat.data.submap import Picture
from sigmasplat.errors import RunError
from sigmasplat.files.atomic import write_text
from sigmasplat.files.json_files import read_text
from sigmasplat.files.reading import guarded
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.graph.candidates import DescribedSubmaps
from sigmasplat.graph.closer import LoopCloser, PendingSearch
from sigmasplat.graph.confidence import Confidence
from sigmasplat.graph.keyframe_graph import GrowingGraph
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.input.source import Source
from sigmasplat.mapping.mapper import Mapper, SecondHalf
from sigmasplat.mapping.window import ValidationView, ValidationViews
from sigmasplat.run.same_conditions import refuse_other_sequence
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.slam.results import Step, Steps
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.drift import Drift
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector, RememberedDepth
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.newest_frame import NewestFrame
from sigmasplat.tracking.pose_prediction import CameraMotion
from sigmasplat.tracking.pose_validation import TrackingStatistics
from sigmasplat.tracking.predicted_depth_fit import DepthFit, DepthShape
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.relocaliser import Relocaliser
from sigmasplat.tracking.tracker import Tracker

CLASSES: tuple[type, ...] = (
    Alignments, Atlas, Camera, CameraMotion, Column, Confidence, DepthFit, DepthShape,
    DescribedSubmaps, Detail, Drift, DynamicDetector, DynamicMask, Edges, FeatureImage, Frame, GaussianField,
    GrowingGraph, Keyframe, KeyframePoses, Loop, LoopCloser, Loops, Mapper, NewestFrame, PendingSearch, Photo, Picture,
    Places, PosePrior, Poses, PreparedFrame, Pyramid, Readout, Readouts, Recovery, Reference, RelativePose, Relocaliser,
    RememberedDepth, Rows, SecondHalf, SensorTimes, Step, Steps, Target, TrackedHops, Tracker, TrackingStatistics,
    ValidationView, ValidationViews, VectorAdam,
)  # fmt: skip
"""The classes that a state may contain."""

REMEMBERED = (
    "atlas", "mapper", "tracker", "drift", "steps", "keyframe_indices", "closer", "recovery", "relocaliser",
    "confidence", "validation_views", "graph", "late",
)  # fmt: skip
"""The attributes of `Slam` that change from frame to frame, except its random numbers."""


def fixed(slam: Slam) -> dict[str, Any]:
    """Return the objects that a state refers to but does not contain: settings, store, view, random numbers, and the
    extractor of features, if there is one."""
    c = slam.config
    settings = {"config": c, "tracking": c.tracking, "recovery": c.recovery, "moving": c.moving}
    extractor = {} if slam.extractor is None else {"extractor": slam.extractor}
    return settings | extractor | {"store": slam.store, "view": slam.view, "random": slam.random}


def state_of(slam: Slam) -> dict[str, Any]:
    """Return the state, when its submaps are on the disk; write it before the next step. At least one frame must have
    been processed."""
    slam.settle()
    remembered = {name: getattr(slam, name) for name in REMEMBERED}
    return {"numbers": slam.random.bit_generator.state, "submaps": len(slam.store)} | remembered


def restore(slam: Slam, state: dict[str, Any]) -> None:
    """Restore a state, read with `fixed(slam)`, in a system that is `prepare`d for the same camera."""
    slam.random.bit_generator.state = state["numbers"]
    for name in REMEMBERED:
        setattr(slam, name, state[name])
    slam.keep_on_disk()


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
    run_save: Callable[[Callable[[], None]], None] = call
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

    Raises RunError if the run is complete, has no state, was made from another sequence, or lacks files of its state.
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
