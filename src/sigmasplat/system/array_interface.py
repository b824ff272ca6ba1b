"""The interface of SLAM for your own camera: images as arrays, covariances, and functions to call at corrections of
earlier poses."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import Array, ColorOrder, frame_from_arrays
from sigmasplat.data.trajectory import LOST
from sigmasplat.errors import SourceError
from sigmasplat.slam.results import Step
from sigmasplat.types import Matrix


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


Listeners = list[Callable[[Correction], object]]


@contextmanager
def notifying(atlas: Atlas, listeners: Listeners) -> Iterator[None]:
    """Tell the listeners of a correction that a block of code has made, after it has ended without an error."""
    before = atlas.copied() if listeners else None
    yield
    if before is not None:
        tell(listeners, [correction_since(before, atlas)])


def tell(listeners: Listeners, corrections: Iterable[Correction | None]) -> None:
    """Call every function with each correction, if there is one."""
    for correction in filter(None, corrections):
        for function in listeners:
            function(correction)


def correction_since(old: Atlas, new: Atlas) -> Correction | None:
    """Return which earlier frames have other poses than in a copy made before, None if none has.

    Poses are compared only if an anchor or a refined keyframe has changed: mapping moves the keyframes of the active
    submap a little at each keyframe, which is no correction.
    """
    refined = new.refined.keys() != old.refined.keys()
    if not refined and np.array_equal(np.array(old.anchors), np.array(new.anchors)[: len(old.anchors)]):
        return None
    count = len(old.places)
    if count and new.places[count - 1][:2] >= (len(old.keyframe_poses) - 1, len(old.keyframe_poses.last)):
        count -= 1  # this frame waited for the next one, and has become a keyframe that `old` does not have
    earlier = new.places.first(count)
    T_before, T_now = (replace(atlas, places=earlier).T_world_camera() for atlas in (old, new))
    frames = np.flatnonzero((T_before != T_now).any((1, 2)))
    if not len(frames):
        return None
    joined = old.components != new.components[: len(old.components)]
    moved_m = np.linalg.norm(T_now[frames, :3, 3] - T_before[frames, :3, 3], axis=1)
    return Correction("final map" if refined else "join" if joined else "loop", frames, T_now[frames], moved_m)


OnCorrection = TypeVar("OnCorrection", bound=Callable[[Correction], object])


class ArrayInterface(ABC):
    """Takes arrays instead of frames, and calls functions when earlier poses have changed."""

    listeners: Listeners

    @abstractmethod
    def step(self, frame: Frame) -> Step:
        """Process one frame."""

    @abstractmethod
    def newest_step(self) -> Step | None:
        """Return the result of the newest frame; None before the first one."""

    @abstractmethod
    def covariance_of(self, newest: Step) -> Matrix | None:
        """Return the covariance of the newest frame's pose, which is not lost, as `covariance`."""

    def covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of the newest frame's pose; None if that frame is lost, or in real time without
        `covariances`.

        Order: position x, y, z (m), then rotation about x, y, z (rad), all in the axes of the world, as in
        geometry_msgs/PoseWithCovariance. It covers the noise and the systematic error of tracking since the first
        camera of the component, its disagreement with mapping, and what closed loops corrected (`path_covariance`). It
        does not cover a wrong pose that tracking did not notice: `Step.p_off` is its probability. For the first frame
        it is 0. Raises SourceError before the first frame.
        """
        newest = self.newest_step()
        if newest is None:
            raise SourceError("no pose yet: give a frame to `track` or `step` first")
        return None if newest.state == LOST else self.covariance_of(newest)

    def track(
        self, rgb: Array, depth: Array, K: Camera | Array, timestamp: float, *, depth_scale: float | None = None,
        color_order: ColorOrder = "rgb", R_inertial_camera: Matrix | None = None,
        T_given_camera: Matrix | None = None,
    ) -> Step:  # fmt: skip
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

    def on_correction(self, function: OnCorrection) -> OnCorrection:
        """Call `function(correction)` when poses of earlier frames have changed: a loop was closed, components joined,
        or `finish` refined the final map. Returns the function, so this can decorate it.

        Functions are called by the thread that called `track`, `step` or `finish`, after the frame is complete. If one
        raises, the exception leaves `track`. The state stays valid, `steps[-1]` has the result, and the next frame can
        be given.
        """
        self.listeners.append(function)
        return function
