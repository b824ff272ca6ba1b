"""The result of one frame and the times of its stages, and the results of all frames."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from sigmasplat.data.poses import Part, Records
from sigmasplat.data.trajectory import APART, LOST, STATES, TRACKED
from sigmasplat.graph.confidence import compared, off_probability
from sigmasplat.graph.loops import Loop
from sigmasplat.render.view import View
from sigmasplat.tracking.newest_frame import FrameEstimate
from sigmasplat.tracking.pose_validation import LOST as LIKELY_WRONG, diagnosis
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix, Stopwatch


@dataclass(frozen=True, eq=False)
class SubmapState:
    """The active submap as a step reports it: number, component, T_world_submap [4, 4], number of splats."""

    number: int = 0
    component: int = 0
    T_world_submap: Matrix = field(default_factory=lambda: np.eye(4))
    splats: int = 0


KERNELS = ("project", "sort", "blend", "blend_backward", "project_backward")
"""The stages that `View.seconds` counts, in its order."""


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """The result of one frame: pose T_world_camera [4, 4], whether it was mapped, whether tracking was lost, results of
    tracking, the number of splats, the submap, the loops that were tried when the submap before ended, and seconds by
    stage.

    state: tracked, relocalised, lost or apart; component: that of the atlas, 0 is the world; p_off: the probability
    that the pose is off by more than 5 cm; covariance [6, 6]: `Slam.covariance()` after this frame, if `Slam.track`
    returned the step; else None.
    """

    index: int
    timestamp_s: float
    T_world_camera: Matrix
    is_keyframe: bool
    lost: bool
    tracking: dict[str, float]
    splats: int
    submap: int = 0
    loops: tuple[Loop, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    state: str = TRACKED
    component: int = 0
    p_off: float = 0.0
    covariance: Matrix | None = None

    @property
    def diagnosis(self) -> str:
        """Return in words what supports the pose, and what speaks against it; empty if surfaces were not compared."""
        seen = compared(self.tracking)
        if seen is None:
            return ""
        unconfirmed = self.tracking.get("doubt", 0.0) > LIKELY_WRONG
        return diagnosis(seen) + "; nothing confirms the place of its keyframe" * unconfirmed


def make_step(
    seen: PreparedFrame, estimate: FrameEstimate, submap: SubmapState, tracker: Tracker,
    loops: Sequence[Loop], seconds: dict[str, float], waiting: int | None = None,
) -> Step:  # fmt: skip
    """Return the result of a frame; submap: the active one; waiting: number of keyframes that wait to be mapped, on two
    clocks."""
    state = APART if submap.component and estimate.state != LOST else estimate.state
    tracking = estimate.logged() | {"doubtful": float(tracker.doubtful), "depth_noise": tracker.statistics.noise}
    tracking |= {} if waiting is None else {"waiting": float(waiting)}
    tracking["moving"] = 0.0 if tracker.front is None else float(tracker.front.hidden.mean())
    p_off = off_probability(state, tracking)
    return Step(
        seen.frame.index, seen.frame.timestamp_s, submap.T_world_submap @ estimate.T_submap_camera, estimate.mapped,
        state == LOST, tracking, submap.splats, submap.number, tuple(loops), seconds, state, submap.component, p_off,
    )  # fmt: skip


@dataclass(eq=False)
class StepTimer(Stopwatch):
    """Wall-clock seconds of one step by stage, including the seconds of the view's kernels. The step begins with it."""

    begin_s: float = field(default_factory=time.perf_counter)
    kernels_before: Matrix = field(default_factory=lambda: np.zeros(len(KERNELS)))

    def start_kernels(self, view: View) -> None:
        """Measure the kernels of the view from now on."""
        self.kernels_before = view.seconds.copy()

    @contextmanager
    def kernels_of(self, view: View, name: str) -> Iterator[None]:
        """Add the time of the view's kernels in a block of code to a stage."""
        before_s = view.seconds.sum()
        yield
        self.add({name: float(view.seconds.sum() - before_s)})

    def stop(self, view: View) -> dict[str, float]:
        """Return the seconds of all stages, of the view's kernels, and in total."""
        kernels_s = (view.seconds - self.kernels_before).tolist()
        self.add(dict(zip(KERNELS, kernels_s, strict=True)) | {"total": time.perf_counter() - self.begin_s})
        return self.seconds


WHOLE_STEPS = 1000
"""Number of newest steps that are kept whole."""


@dataclass(eq=False)
class Steps(Records[Step]):
    """The steps of all frames. Only the newest `WHOLE_STEPS` are kept whole; of earlier ones the values of tracking,
    loops, seconds and the covariance are dropped: they take most of the memory, and nothing reads them later.

    frame: its number in the source; state: its number in `STATES`; whole: the newest steps by number.
    """

    frame = Part(np.int64)
    timestamps_s = Part(np.float64)
    is_keyframe = Part(np.bool_)
    lost = Part(np.bool_)
    splats = Part(np.int64)
    submap = Part(np.int64)
    state = Part(np.int64)
    component = Part(np.int64)
    p_off = Part(np.float64)
    T_world_camera = Part(np.float64, 4, 4)

    whole: dict[int, Step] = field(default_factory=dict)

    def append(self, step: Step) -> None:
        """Append the result of the next frame."""
        number = len(self)
        self.whole[number] = step
        self.whole.pop(number - WHOLE_STEPS, None)
        self.add(
            step.index, step.timestamp_s, step.is_keyframe, step.lost, step.splats, step.submap,
            STATES.index(step.state), step.component, step.p_off, step.T_world_camera,
        )  # fmt: skip

    @property
    def states(self) -> list[str]:
        """Return the state of each frame."""
        return [STATES[number] for number in self.state]

    def _record(self, i: int) -> Step:
        if (step := self.whole.get(i)) is not None:
            return step
        index, timestamp_s, is_keyframe, lost, splats, submap, state, component, p_off, T = self.values(i)
        return Step(
            index, timestamp_s, T, is_keyframe, lost, {}, splats, submap, state=STATES[state], component=component,
            p_off=p_off,
        )  # fmt: skip
