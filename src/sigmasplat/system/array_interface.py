"""The interface of SLAM for your own camera: images as arrays, covariances, and functions to call at keyframes, closed
loops and corrections of earlier poses."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Literal, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import Array, ColorOrder, frame_from_arrays
from sigmasplat.errors import SourceError
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.slam.results import Step, Steps
from sigmasplat.types import Matrix

Event = TypeVar("Event")
Method = TypeVar("Method", bound=Callable[..., Any])


@dataclass(frozen=True, eq=False)
class Correction:
    """The poses of earlier frames have changed.

    reason: "loop" if a loop was closed, "join" if a component joined another, "final map" at the end; frames [n]: the
    rows of `trajectory()` that moved, without the newest frame; T_world_camera [n, 4, 4]: their poses now; moved_m [n]:
    how far they moved.
    """

    reason: Literal["loop", "join", "final map"]
    frames: NDArray[np.int64]
    T_world_camera: Matrix
    moved_m: Matrix


class Observed(Protocol):
    """What listeners read of a SLAM system."""

    atlas: Atlas
    steps: Steps
    listeners: "Listeners"

    @property
    def loops(self) -> Loops: ...


@dataclass(frozen=True, eq=False)
class Before:
    """The state before a step, as far as listeners need it. closed [L]: which pairs of submaps were closed loops."""

    atlas: Atlas
    steps: int
    closed: NDArray[np.bool_]

    @staticmethod
    def of(slam: Observed) -> "Before":
        """Copy what a step may change."""
        a = slam.atlas
        kept = replace(
            a, anchors=a.anchors.copied(), components=list(a.components), refined=dict(a.refined),
            keyframe_poses=a.keyframe_poses.copied(),
        )  # fmt: skip
        return Before(kept, len(slam.steps), slam.loops.accepted)


@dataclass(eq=False)
class Listeners:
    """The functions to call, in the order in which they were added."""

    keyframe: list[Callable[[Step], object]] = field(default_factory=list)
    loop: list[Callable[[Loop], object]] = field(default_factory=list)
    correction: list[Callable[[Correction], object]] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.keyframe or self.loop or self.correction)

    def notify(self, slam: Observed, before: Before) -> None:
        """Call the functions for what happened since `before`."""
        closed = slam.loops.newly_closed(before.closed)
        correction = correction_since(slam, before) if self.correction else None
        corrections = [] if correction is None else [correction]
        self.call([step for step in slam.steps[before.steps :] if step.is_keyframe], closed, corrections)

    def call(self, keyframes: Sequence[Step], closed: Sequence[Loop], corrections: Sequence[Correction]) -> None:
        """Call the functions for keyframes, closed loops and corrections. If functions raise, the others are still
        called, then the first exception is raised."""
        problems = _called(self.keyframe, keyframes) + _called(self.loop, closed)
        problems += _called(self.correction, corrections)
        if problems:
            raise problems[0]


class Events:
    """Collects what the work on the map reports, until the caller's functions can be called."""

    def __init__(self, loops: Loops) -> None:
        self._closed = loops.accepted
        self._new: list[Loop] = []
        self._corrections: list[Correction] = []

    def add(self, loops: Loops, correction: Correction | None) -> None:
        """Add what a snapshot contains; loops: all pairs tried so far."""
        self._new += loops.newly_closed(self._closed)
        before, self._closed = self._closed, loops.accepted
        self._closed[: len(before)] |= before
        if correction is not None:
            self._corrections.append(correction)

    def tell(self, listeners: Listeners, keyframes: Sequence[Step] = ()) -> None:
        """Call the functions for everything collected, and forget it."""
        closed, corrections, self._new, self._corrections = self._new, self._corrections, [], []
        listeners.call(keyframes, closed, corrections)


def notifying(method: Method) -> Method:
    """Make a method of SLAM call the listeners after it has ended without an error."""

    @wraps(method)
    def notified(slam: Observed, /, *args: Any, **named: Any) -> Any:
        if not slam.listeners:
            return method(slam, *args, **named)
        before = Before.of(slam)
        result = method(slam, *args, **named)
        slam.listeners.notify(slam, before)
        return result

    return cast(Method, notified)


def correction_since(slam: Observed, before: Before) -> Correction | None:
    """Return which earlier frames have other poses than before, None if none has.

    Poses are compared only if an anchor or a refined keyframe has changed: mapping moves the keyframes of the active
    submap a little at each keyframe, which is no correction.
    """
    old, new = before.atlas, slam.atlas
    refined = new.refined.keys() != old.refined.keys()
    if not refined and np.array_equal(np.array(old.anchors), np.array(new.anchors)[: len(old.anchors)]):
        return None
    earlier = new.places.first(before.steps)
    T_before, T_now = (replace(atlas, places=earlier).T_world_camera() for atlas in (old, new))
    frames = np.flatnonzero((T_before != T_now).any((1, 2)))
    if not len(frames):
        return None
    joined = old.components != new.components[: len(old.components)]
    moved_m = np.linalg.norm(T_now[frames, :3, 3] - T_before[frames, :3, 3], axis=1)
    return Correction("final map" if refined else "join" if joined else "loop", frames, T_now[frames], moved_m)


def _called(functions: Sequence[Callable[[Event], object]], events: Sequence[Event]) -> list[Exception]:
    """Call every function with every event; return the exceptions they raise."""
    problems = []
    for function, event in ((function, event) for event in events for function in functions):
        try:
            function(event)
        except Exception as problem:
            problems.append(problem)
    return problems


OnKeyframe = TypeVar("OnKeyframe", bound=Callable[[Step], object])
OnLoop = TypeVar("OnLoop", bound=Callable[[Loop], object])
OnCorrection = TypeVar("OnCorrection", bound=Callable[[Correction], object])


class ArrayInterface(ABC):
    """Takes arrays instead of frames, and calls functions at events."""

    listeners: Listeners

    @abstractmethod
    def step(self, frame: Frame) -> Step:
        """Process one frame."""

    @abstractmethod
    def newest_step(self) -> Step | None:
        """Return the result of the newest frame; None before the first one."""

    @abstractmethod
    def covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of the newest frame's pose; None if that frame is lost."""

    def track(
        self,
        rgb: Array,
        depth: Array,
        K: Camera | Array,
        timestamp: float,
        *,
        depth_scale: float | None = None,
        color_order: ColorOrder = "rgb",
        R_inertial_camera: Matrix | None = None,
        T_given_camera: Matrix | None = None,
    ) -> Step:
        """Process one pair of images from your own camera: `step` for arrays, with the covariance of the pose.

        rgb [H, W, 3]: uint8, or float in [0, 1]; color_order: "bgr" for images of OpenCV. depth [H, W]: registered to
        colour, along the optical axis, 0 = no reading; float in metres, or whole numbers with depth_scale, the units
        per metre (1000 for millimetres). Both are numpy arrays or torch tensors; they are copied, never changed. K: of
        the undistorted images, a 3×3 matrix, (fx, fy, cx, cy) in pixels, or a `Camera`; the same for all frames.
        timestamp: seconds, increasing. R_inertial_camera [3, 3]: rotation measured by a gyroscope, as in `Frame`.
        T_given_camera [4, 4]: the pose of the camera, if you know it: it is used as it is, as in `Frame`.

        Raises SourceError with the remedy if an argument is not as described; the state is then unchanged, and the
        next image can be given.
        """
        newest = self.newest_step()
        frame = frame_from_arrays(
            rgb, depth, K, timestamp, index=0 if newest is None else newest.index + 1, depth_scale=depth_scale,
            color_order=color_order, R_inertial_camera=R_inertial_camera, T_given_camera=T_given_camera,
        )  # fmt: skip
        if newest is not None and frame.timestamp_s <= newest.timestamp_s:
            order = "repeats" if frame.timestamp_s == newest.timestamp_s else "is before"
            raise SourceError(
                f"timestamp {frame.timestamp_s} s {order} that of the frame before ({newest.timestamp_s} s); give "
                "increasing times"
            )
        return replace(self.step(frame), covariance=self.covariance())

    def on_keyframe(self, function: OnKeyframe) -> OnKeyframe:
        """Call `function(step)` after each frame that became a keyframe. Returns the function, so this can decorate it.

        The functions of this and the next two methods are called by the thread that called `track`, `step` or
        `finish`, after the frame is complete. If one raises, the others are still called; then the exception leaves
        `track`. The state stays valid, `steps[-1]` has the result, and the next frame can be given.
        """
        self.listeners.keyframe.append(function)
        return function

    def on_loop(self, function: OnLoop) -> OnLoop:
        """Call `function(loop)` for each loop that is closed, also during `finish`."""
        self.listeners.loop.append(function)
        return function

    def on_correction(self, function: OnCorrection) -> OnCorrection:
        """Call `function(correction)` when poses of earlier frames have changed: a loop was closed, components joined,
        or `finish` refined the final map."""
        self.listeners.correction.append(function)
        return function
