"""What is wrong with the camera that a recording states, as `sigmasplat calibrate` measures it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import SensorTimes

Floats = NDArray[np.float32]
SAID = {
    "focal length": "%", "image centre to the right": "% of the width", "image centre down": "% of the width",
    "inverse depth": "/100 m", "darker corners": "%",
}  # fmt: skip


@dataclass(frozen=True)
class CameraErrors:
    """Differences of the true camera from the stated one.

    focal: of the focal length, as a share; center_x, center_y: of the image centre, to the right and down, as shares of
    the width; inverse_depth: of inverse depth, per metre; falloff: share by which the corners of an image are darker
    than its middle (vignetting), which grows with the square of the distance from it. std: standard deviations of all
    five, None: nothing is measured.
    """

    focal: float = 0.0
    center_x: float = 0.0
    center_y: float = 0.0
    inverse_depth: float = 0.0
    falloff: float = 0.0
    std: tuple[float, ...] | None = field(default=None, kw_only=True)

    @staticmethod
    def noted_in(facts: Mapping[str, Any]) -> "CameraErrors":
        """Return the errors in the facts of a run or in a file, where `noted` has written them."""
        noted = facts.get("camera_errors")
        return CameraErrors(**{**noted, "std": tuple(noted["std"])}) if noted else KNOWN_NONE

    @staticmethod
    def given(text: str) -> "CameraErrors":
        """Return the errors that `input.calibrate` gives as numbers, after those of the times."""
        numbers = np.array(text.split(",")[6:], np.float64).tolist()
        return CameraErrors(*numbers[:5], std=tuple(numbers[5:])) if numbers else KNOWN_NONE

    @property
    def values(self) -> tuple[float, float, float, float, float]:
        """Return all five errors."""
        return self.focal, self.center_x, self.center_y, self.inverse_depth, self.falloff

    def noted(self) -> dict[str, Any]:
        """Return the errors as facts of a run; nothing if they are not known."""
        return {} if self.std is None else {"camera_errors": asdict(self)}

    def said(self) -> str:
        """Return the errors in words, empty if none is known."""
        if self.std is None:
            return ""
        found = (
            f"{name} {100 * value:.2f} ± {100 * std:.2f} {unit}"
            for (name, unit), value, std in zip(SAID.items(), self.values, self.std, strict=True) if value
        )  # fmt: skip
        return f"the stated camera is off by {said} (corrected)" if (said := ", ".join(found)) else ""

    def camera(self, stated: Camera) -> Camera:
        """Return the true camera."""
        factor, width = 1.0 + self.focal, stated.width
        return replace(
            stated, fx=stated.fx * factor, fy=stated.fy * factor,
            cx=stated.cx + self.center_x * width, cy=stated.cy + self.center_y * width,
        )  # fmt: skip

    def depth(self, stated_m: Floats) -> Floats:
        """Return true depth, m; 0 stays no reading."""
        if not self.inverse_depth:
            return stated_m
        inverse = 1.0 / np.maximum(stated_m, np.float32(1e-3)) + np.float32(self.inverse_depth)
        return np.where((stated_m > 0.0) & (inverse > 0.0), 1.0 / np.maximum(inverse, 1e-3), 0.0).astype(np.float32)

    def frame(self, stated: Frame) -> Frame:
        """Return a frame as the true camera sees it, and as bright in the corners as in the middle."""
        color = np.minimum(self.evened(stated.color, stated.camera), 1.0) if self.falloff else stated.color
        return replace(stated, camera=self.camera(stated.camera), color=color, depth_m=self.depth(stated.depth_m))

    def evened(self, recorded: Floats, camera: Camera) -> Floats:
        """Return gray or colour [H, W, ...] that is as bright in the corners as in the middle; it may exceed 1."""
        bright = brightness(self.falloff, camera)
        return np.asarray(recorded / (bright if recorded.ndim == 2 else bright[..., None]), np.float32)


KNOWN_NONE = CameraErrors()


def sensor_said(facts: Mapping[str, Any]) -> str:
    """Return what the facts of a run or of a file note of its sensor, in words."""
    return "; ".join(filter(None, (SensorTimes.noted_in(facts).said(), CameraErrors.noted_in(facts).said())))


@lru_cache(maxsize=8)
def brightness(falloff: float, camera: Camera) -> Floats:
    """Return the share of light [H, W], above 0, that reaches the pixels of a camera with this fall-off."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    return np.asarray(np.maximum(1.0 - falloff * corner_share(u, v, camera), 1e-3), np.float32)


def corner_share(u: Floats, v: Floats, camera: Camera) -> Floats:
    """Return the squared distance of columns and rows from the middle of the image, relative to that of a corner."""
    x, y = (camera.width - 1) / 2.0, (camera.height - 1) / 2.0
    return np.asarray(((u - x) ** 2 + (v - y) ** 2) / (x * x + y * y), np.float32)
