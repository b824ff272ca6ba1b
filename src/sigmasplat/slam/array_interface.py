"""The interface of SLAM for your own camera: images as arrays, covariances, and functions to call at events."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import Array, ColorOrder, frame_from_arrays
from sigmasplat.errors import SourceError
from sigmasplat.graph.loops import Loop
from sigmasplat.slam.listeners import Correction, Listeners
from sigmasplat.slam.results import Step
from sigmasplat.types import Matrix

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
