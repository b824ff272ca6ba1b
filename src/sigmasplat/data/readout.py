"""When a sensor reads its images, and how its camera moves meanwhile; images rewritten as if read at once."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.poses import Part, Records
from sigmasplat.env import opencv
from sigmasplat.native import _core
from sigmasplat.types import Matrix


@dataclass(frozen=True)
class SensorTimes:
    """When a sensor reads depth and rows, s: depth after colour, beyond what the files say; and how long depth and
    colour take from the first row to the last (rolling shutter). std_s: standard deviations of all three, None: nothing
    is measured, and all is taken as read at once."""

    depth_late_s: float = 0.0
    depth_rows_s: float = 0.0
    color_rows_s: float = 0.0
    std_s: tuple[float, ...] | None = field(default=None, kw_only=True)

    @staticmethod
    def noted_in(facts: Mapping[str, Any]) -> "SensorTimes":
        """Return the times in the facts of a run (run.json), where `noted` has written them."""
        noted = facts.get("sensor_times")
        return SensorTimes(**{**noted, "std_s": tuple(noted["std_s"])}) if noted else UNKNOWN_TIMES

    @staticmethod
    def given(text: str) -> "SensorTimes":
        """Return the times that `input.calibrate` gives as numbers; they are not known if it is a word."""
        numbers = np.array(text.split(",") if "," in text else [], np.float64).tolist()
        return SensorTimes(*numbers[:3], std_s=tuple(numbers[3:6])) if numbers else UNKNOWN_TIMES

    def noted(self) -> dict[str, Any]:
        """Return the times as facts of a run; nothing if they are not known."""
        return {} if self.std_s is None else {"sensor_times": asdict(self)}

    def said(self) -> str:
        """Return the times in words, empty if they are not known."""
        if self.std_s is None:
            return ""
        late, depth, color = (f"{1e3 * std_s:.{int(std_s < 0.001)}f} ms" for std_s in self.std_s)
        if self.at_once:
            return f"the sensor reads nothing late (± {color} for colour, {depth} for depth, {late} between both)"
        return (
            f"the sensor reads colour in {1e3 * self.color_rows_s:.0f} ± {color}, depth in "
            f"{1e3 * self.depth_rows_s:.0f} ± {depth} and {1e3 * abs(self.depth_late_s):.0f} ± {late} "
            f"{'late' if self.depth_late_s > 0 else 'early'} (corrected)"
        )

    def read(self, image: "Readout") -> "Readout | None":
        """Return when the rows of an image were read; None if that is not known, or does not matter at rest."""
        return replace(image, times=self) if self.matter(image.late_s) and image.rate.any() else None

    def matter(self, late_s: float) -> bool:
        """Return whether an image of a moving camera is read late; late_s: as of `Readout`."""
        return self.std_s is not None and bool(late_s or not self.at_once)

    @property
    def at_once(self) -> bool:
        """Return whether all is read at once."""
        return not (self.depth_late_s or self.depth_rows_s or self.color_rows_s)


UNKNOWN_TIMES = SensorTimes()


@dataclass(frozen=True, eq=False)
class Readout:
    """When the rows of an image were read, and how its camera moved meanwhile: a twist (v, ω) per second [6] in its
    axes. late_s: time of depth after colour that the files say. The pose of the image is that of the camera in the
    middle of its colour."""

    rate: Matrix
    late_s: float = 0.0
    times: SensorTimes = UNKNOWN_TIMES

    @property
    def numbers(self) -> list[float]:
        """Return the numbers [9] in the order of the kernels' `Readout`."""
        t = self.times
        return [*self.rate.tolist(), self.late_s + t.depth_late_s, t.depth_rows_s, t.color_rows_s]


AT_ONCE = Readout(np.zeros(6))


def readouts(reference: Readout | None, live: Readout | None) -> list[float]:
    """Return the numbers [18] of two images for the kernels; none if all rows of both were read at once."""
    return [] if reference is live is None else [*(reference or AT_ONCE).numbers, *(live or AT_ONCE).numbers]


@dataclass(eq=False)
class Readouts(Records[Readout]):
    """Those of all keyframes, submap by submap, without the times of the sensor."""

    rate = Part(np.float64, 6)
    late_s = Part(np.float64)

    def append(self, readout: Readout) -> None:
        """Append that of the next keyframe."""
        self.add(readout.rate, readout.late_s)

    def correct(self, rows: NDArray[np.int64] | int, rates: Matrix) -> None:
        """Replace the motion [6] of some, because it is known better, or because their images were rewritten."""
        self.rows.used[rows, :6] = rates

    def _record(self, i: int) -> Readout:
        return Readout(*self.values(i))


ROUNDS = 2
"""What is read at a pixel depends on where its point was then, and that on the row; so often is it looked up."""
SAME_SURFACE = 0.03
"""Readings of one surface differ by less than this share, as in alignment (native/align_pixel.h)."""
Image = NDArray[Any]


def read_at_once(frame: Frame, readout: Readout) -> Frame:
    """Return the frame with colour [H, W, 3] and depth [H, W] as the camera sees them in the middle of its colour.

    Each pixel is looked up where its point was when its row was read; its motion is that of `readout.rate`, to second
    order. Pixels without depth move as those at the median depth.
    """
    cv2, color_at = opencv(), np.empty((2, *frame.depth_m.shape), np.float32)
    color, depth_m = frame.color, depth_of_color(frame.camera, frame.depth_m, readout, color_at)
    if readout.times.color_rows_s:
        color = cv2.remap(color, *color_at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0.0, 1.0)
    return replace(frame, color=color, depth_m=depth_m)


def depth_of_color(camera: Camera, depth_m: Image, readout: Readout, color_at: Image | None = None) -> Image:
    """Return the depth [H, W] of what each pixel shows in colour, when its colour is read; 0 where none is read. Beyond
    the depth image it is that of its border. With color_at [2, H, W]: the depth that the camera saw in the middle of
    colour; the column and row at which colour shows it are written there."""
    c, before_m, some_m = camera, np.empty(depth_m.shape, np.float32), depth_m[::4, ::4]
    usual_m = float(np.median(some_m[some_m > 0])) if (some_m > 0).any() else 1.0
    _core.read_before(
        np.ascontiguousarray(depth_m, np.float32), [c.fx, c.fy, c.cx, c.cy], readout.numbers, ROUNDS, SAME_SURFACE,
        usual_m, before_m, color_at,
    )  # fmt: skip
    return before_m
