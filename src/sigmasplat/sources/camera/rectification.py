"""Bring the images of a recording into one pinhole camera: lenses out, depth registered to colour."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.model.camera import Camera
from sigmasplat.sources.camera.calibration import Calibration
from sigmasplat.sources.camera.depth_registration import DepthRegistration
from sigmasplat.sources.camera.distortion import Undistortion

Image = NDArray[np.float32]


def registers_depth(calibration: Calibration, settings: InputConfig) -> bool:
    """Tell whether depth is moved to the colour camera: where the cameras are known, and unless the settings say no."""
    wanted = calibration.register_by_default if settings.register_depth == "auto" else settings.register_depth == "on"
    return wanted and calibration.depth_camera is not None


class Rectification:
    """Turn recorded colour and depth into images of `camera`, as the settings ask.

    Registered depth has the colour image's pixels and lens. Depth of a camera of its own is taken out of its lens,
    then moved to the colour camera, which is made no finer than the depth camera is, or the images worked on.
    """

    def __init__(self, name: str, calibration: Calibration, settings: InputConfig) -> None:
        """Raises SourceError where depth is to be registered and the calibration does not say how."""
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
        """Return the camera that depth is to be moved from, None where it stays as it is."""
        known = self.calibration.depth_camera
        if settings.register_depth == "on" and known is None:
            raise SourceError(
                f"{name}: depth cannot be registered, the depth camera is unknown; "
                "give depth_camera and T_color_depth in calibration.json"
            )
        return known if registers_depth(self.calibration, settings) else None

    @property
    def moves_depth(self) -> bool:
        """Tell whether depth is moved to the colour camera."""
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
        """Return depth [H, W] of `camera` from the recorded one."""
        if self._depth_lens:
            depth_m = self._depth_lens.depth(depth_m)
        return self._registration(depth_m) if self._registration else depth_m


def check_image_sizes(
    rectification: Rectification, color: Path, color_size: tuple[int, ...], depth: Path, depth_size: tuple[int, ...]
) -> None:
    """Raise SourceError where an image's (width, height) is not that of its camera."""
    c = rectification.calibration.camera
    if tuple(color_size) != tuple(depth_size) and not rectification.moves_depth:
        raise SourceError(
            f"{color} is {color_size[0]}×{color_size[1]} but {depth} is {depth_size[0]}×{depth_size[1]}; "
            "register depth to colour and give both one size, or name depth_camera in calibration.json"
        )
    for what, path, size, wanted in (
        ("colour", color, color_size, (c.width, c.height)),
        ("depth", depth, depth_size, rectification.depth_size),
    ):
        if tuple(size) != wanted:
            raise SourceError(
                f"{path} is {size[0]}×{size[1]} but the calibration is for {wanted[0]}×{wanted[1]}; "
                f"take images of that size, or mend the {what} camera's calibration"
            )


def _undistortion(camera: Camera, coefficients: tuple[float, ...] | None) -> Undistortion | None:
    return Undistortion(camera, np.array(coefficients)) if coefficients else None


def _limited_width(color: Camera, width: int) -> Camera:
    """Return the colour camera at no more than so many pixels across."""
    return color if color.width <= width else color.resized(width, round(color.height * width / color.width))
