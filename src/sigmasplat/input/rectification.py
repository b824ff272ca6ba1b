"""Rectify the images of a recording to one pinhole camera: lens distortion removed, depth registered to colour."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import Calibration
from sigmasplat.input.depth_registration import DepthRegistration
from sigmasplat.input.distortion import Undistortion

Image = NDArray[np.float32]


def registers_depth(calibration: Calibration, settings: InputConfig) -> bool:
    """Return whether depth is moved to the colour camera: if the depth camera is known and the settings allow it."""
    wanted = calibration.register_by_default if settings.register_depth == "auto" else settings.register_depth == "on"
    return wanted and calibration.depth_camera is not None


class Rectification:
    """Convert recorded colour and depth to images of `camera`, as the settings say.

    Registered depth has the colour image's pixels and distortion. Depth of a separate camera is undistorted, then moved
    to the colour camera, whose width is reduced to that of the depth camera or the working width, the larger of both.
    """

    def __init__(self, name: str, calibration: Calibration, settings: InputConfig) -> None:
        """Prepare the remap tables. Raises SourceError if depth must be registered but the depth camera is unknown."""
        self.calibration = calibration
        lens = calibration.distortion if settings.undistort else None
        depth_lens = calibration.depth_distortion if settings.undistort else None
        depth_camera = self._depth_camera(name, settings)
        self.camera = calibration.camera
        self._color_lens = _undistortion(calibration.camera, lens)
        self._depth_lens = self._color_lens
        self._registration: DepthRegistration | None = None
        if depth_camera is not None:
            self.camera = _limited_width(calibration.camera, max(depth_camera.width, settings.width))
            self._depth_lens = _undistortion(depth_camera, depth_lens)
            self._registration = DepthRegistration(depth_camera, self.camera, calibration.T_color_depth)

    def _depth_camera(self, name: str, settings: InputConfig) -> Camera | None:
        """Return the camera that depth is moved from, None if depth is not moved."""
        known = self.calibration.depth_camera
        if settings.register_depth == "on" and known is None:
            raise SourceError(
                f"{name}: depth cannot be registered, the depth camera is unknown; "
                "give depth_camera and T_color_depth in calibration.json"
            )
        return known if registers_depth(self.calibration, settings) else None

    @property
    def moves_depth(self) -> bool:
        """Return whether depth is moved to the colour camera."""
        return self._registration is not None

    @property
    def depth_size(self) -> tuple[int, int]:
        """Return (width, height) that depth images must have."""
        camera = self._registration.depth_camera if self._registration else self.calibration.camera
        return camera.width, camera.height

    def __call__(self, color: Image, depth_m: Image) -> tuple[Image, Image]:
        """Return colour [H, W, 3] and depth [H, W] of `camera` from the recorded ones."""
        return self._color_lens.color(color) if self._color_lens else color, self.depth(depth_m)

    def depth(self, depth_m: Image) -> Image:
        """Return depth [H, W] of `camera` from recorded depth."""
        if self._depth_lens:
            depth_m = self._depth_lens.depth(depth_m)
        return self._registration(depth_m) if self._registration else depth_m


def check_image_sizes(
    rectification: Rectification, color: Path, color_size: tuple[int, ...], depth: Path, depth_size: tuple[int, ...]
) -> None:
    """Raise SourceError if the (width, height) of an image is not that of its camera."""
    c = rectification.calibration.camera
    if tuple(color_size) != tuple(depth_size) and not rectification.moves_depth:
        raise SourceError(
            f"{color} is {color_size[0]}×{color_size[1]} but {depth} is {depth_size[0]}×{depth_size[1]}; "
            "register depth to colour at the same size, or give depth_camera in calibration.json"
        )
    for what, path, size, wanted in (
        ("colour", color, color_size, (c.width, c.height)),
        ("depth", depth, depth_size, rectification.depth_size),
    ):
        if tuple(size) != wanted:
            raise SourceError(
                f"{path} is {size[0]}×{size[1]} but the calibration is for {wanted[0]}×{wanted[1]}; "
                f"take images of that size, or correct the calibration of the {what} camera"
            )


def _undistortion(camera: Camera, coefficients: tuple[float, ...] | None) -> Undistortion | None:
    return Undistortion(camera, np.array(coefficients)) if coefficients else None


def _limited_width(color: Camera, width: int) -> Camera:
    """Return the colour camera with at most `width` pixels per row."""
    return color if color.width <= width else color.resized(width, round(color.height * width / color.width))
