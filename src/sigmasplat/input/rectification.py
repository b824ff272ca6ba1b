"""Rectify the images of a recording to one pinhole camera: remove lens distortion, register depth to colour."""

from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import Calibration, refuse_impossible_camera
from sigmasplat.input.images import color_origins

Points = NDArray[np.float64]


def distort(points: Points, coefficients: Points) -> Points:
    """Map ideal image points [..., 2] (x/z, y/z) to distorted image points.

    Coefficients k1, k2, p1, p2, k3 [, k4, k5, k6], the last three for the rational model (OpenCV's order).
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    along_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    return np.stack([along_x, y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y], -1)


class Undistortion:
    """Resample distorted images to the pinhole camera with the same focal lengths and principal point.

    Depth is resampled together with colour: TUM's depth is registered to the *distorted* colour image, so undistorting
    colour alone would misalign them by up to 20 pixels in the corners (the CG-SLAM release undistorts colour only).
    Colour is interpolated. Depth takes the nearest reading, because a mean of a near and a far surface is no surface.
    """

    def __init__(self, camera: Camera, coefficients: Points) -> None:
        self.camera = camera
        self.coefficients = coefficients

    @cached_property
    def _source_uv(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Column and row of each ideal pixel in the recorded image, [H, W] each."""
        c = self.camera
        lens = distort(c.rays()[..., :2].astype(np.float64), self.coefficients)
        u, v = (lens * [c.fx, c.fy] + [c.cx, c.cy]).astype(np.float32).transpose(2, 0, 1)
        return np.ascontiguousarray(u), np.ascontiguousarray(v)

    def color(self, recorded: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample colour [H, W, 3] bilinearly; outside the recorded image edge pixels repeat (depth is 0)."""
        cv2 = opencv()
        resampled = cv2.remap(recorded, *self._source_uv, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.minimum(resampled, 1.0, out=resampled))

    def depth(self, recorded_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample depth [H, W] by the nearest reading; 0 outside the recorded image."""
        cv2 = opencv()
        return np.asarray(cv2.remap(recorded_m, *self._source_uv, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT))


def resampled(image: NDArray[np.float32], own: Camera, camera: Camera) -> NDArray[np.float32]:
    """Resample colour [H, W, 3] or depth [H, W] of a frame's own camera as if `camera` had taken it with its lens."""
    cv2, size, depth = opencv(), image.shape[1::-1], image.ndim == 2
    own, camera = own.resized(*size), camera.resized(*size)
    x, y = own.fx / camera.fx, own.fy / camera.fy
    M = np.array([[x, 0.0, own.cx - x * camera.cx], [0.0, y, own.cy - y * camera.cy]])
    flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_NEAREST if depth else cv2.INTER_LINEAR)
    border = cv2.BORDER_CONSTANT if depth else cv2.BORDER_REPLICATE
    return np.asarray(cv2.warpAffine(image, M, size, flags=flags, borderMode=border))


OVERLAP, MAX_HALF_FOOTPRINT_PX = 1.1, 32.0
"""Footprints are enlarged by this factor, so that rotation leaves no gaps between neighbours. Half of the largest one:
a reading near the camera centre must not fill the image."""
CHUNK_READINGS = 8192
"""Readings processed together: few enough for the processor's cache."""

Floats = NDArray[np.float64]


class DepthRegistration:
    """Draw each depth pixel as the square that it covers in the colour image; where squares overlap, the nearest wins.

    A surface hidden from the colour camera therefore does not show through one in front of it, and a small depth image
    fills a larger colour image. T_color_depth [4, 4] transforms depth camera points to the colour camera, metres.
    """

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: Floats) -> None:
        self.depth_camera = depth_camera
        self.color_camera = color_camera
        self.T_color_depth = T_color_depth

    @cached_property
    def _rays(self) -> Floats:
        """Return the ray of each depth pixel in the colour camera's axes [3, H·W]."""
        rays = self.depth_camera.rays().reshape(-1, 3).astype(np.float64) @ self.T_color_depth[:3, :3].T
        return np.ascontiguousarray(rays.T)

    def __call__(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth [H, W] for the colour camera from depth [h, w] of the depth camera, m; 0 = no reading."""
        c, z_depth = self.color_camera, depth_m.reshape(-1)
        nearest = np.full(c.height * c.width, np.inf)
        for first in range(0, len(z_depth), CHUNK_READINGS):
            valid = first + np.flatnonzero(z_depth[first : first + CHUNK_READINGS] > 0)
            draw_footprints(nearest, c.width, *self._footprints(valid, z_depth[valid]))
        nearest[np.isinf(nearest)] = 0.0
        return nearest.astype(np.float32).reshape(c.height, c.width)

    def _footprints(self, valid: NDArray[np.int64], z_depth: NDArray[np.float32]) -> tuple[Floats, Floats, Floats]:
        """Return first and last column and row [2, N] covered by the depth pixels `valid`, and their depth [N] m."""
        c, d, t = self.color_camera, self.depth_camera, self.T_color_depth[:3, 3]
        x, y, z = (self._rays[axis].take(valid) * z_depth + t[axis] for axis in range(3))
        if not (front := z > 1e-6).all():
            x, y, z, z_depth = x[front], y[front], z[front], z_depth[front]
        size = OVERLAP * z_depth / z
        columns = _span(c.fx * x / z + c.cx, 0.5 * size * c.fx / d.fx, c.width)
        rows = _span(c.fy * y / z + c.cy, 0.5 * size * c.fy / d.fy, c.height)
        return columns, rows, z


def draw_footprints(nearest: Floats, width: int, columns: Floats, rows: Floats, z: Floats) -> None:
    """Write depths z [N] to pixels first … last [2, N] of an image `nearest` [rows · width]; the smallest wins."""
    most = [int(np.fmax.reduce(ends[1] - ends[0], initial=-1.0)) for ends in (columns, rows)]
    for dy in range(most[1] + 1):
        for dx in range(most[0] + 1):
            column, row = columns[0] + dx, rows[0] + dy
            covered = np.flatnonzero((column <= columns[1]) & (row <= rows[1]))
            pixels = (row * width + column).take(covered).astype(np.int64)
            np.minimum.at(nearest, pixels, z.take(covered))


def _span(centre: Floats, half: Floats, count: int) -> Floats:
    """Return first and last pixel of `count` whose centre is within centre ± half, [2, N]; last < first if none."""
    bounded = np.clip(half, 0.0, MAX_HALF_FOOTPRINT_PX)
    return np.stack([np.maximum(np.ceil(centre - bounded), 0.0), np.minimum(np.floor(centre + bounded), count - 1.0)])


Image = NDArray[np.float32]


def registers_depth(calibration: Calibration, settings: InputConfig) -> bool:
    """Return whether depth is moved to the colour camera: if the depth camera is known and the settings allow it."""
    return settings.register_depth != "off" and calibration.depth_camera is not None


class Rectification:
    """Convert recorded colour and depth to images of `camera`, as the settings say.

    Registered depth has the colour image's pixels and distortion. Depth of a separate camera is undistorted, then moved
    to the colour camera, whose width is reduced to that of the depth camera or the working width, the larger of both.
    """

    def __init__(self, name: str, calibration: Calibration, settings: InputConfig) -> None:
        """Prepare the remap tables. Raises SourceError if a camera is impossible, or depth's unknown but needed."""
        refuse_impossible_camera(name, calibration.camera)
        self.calibration = calibration
        self.ray_lengths: NDArray[np.float32] | None = None  # if depth is stored along the ray
        self.beyond_m = float("inf")  # from here on, a value is no reading
        lens = calibration.distortion if settings.undistort else None
        depth_lens = calibration.depth_distortion if settings.undistort else None
        if settings.register_depth == "on" and calibration.depth_camera is None:
            raise SourceError(
                f"{name}: depth cannot be registered, the depth camera is unknown; "
                "give depth_camera and T_color_depth in calibration.json"
            )
        depth_camera = calibration.depth_camera if registers_depth(calibration, settings) else None
        self.camera = calibration.camera
        self._color_lens = _undistortion(calibration.camera, lens)
        self._depth_lens = self._color_lens
        self._registration: DepthRegistration | None = None
        if depth_camera is not None:
            color, width = calibration.camera, max(depth_camera.width, settings.width)
            if color.width > width:
                self.camera = color.resized(width, round(color.height * width / color.width))
            self._depth_lens = _undistortion(depth_camera, depth_lens)
            self._registration = DepthRegistration(depth_camera, self.camera, calibration.T_color_depth)

    @property
    def moves_depth(self) -> bool:
        """Return whether depth is moved to the colour camera."""
        return self._registration is not None

    @property
    def depth_camera(self) -> Camera:
        """Return the camera of recorded depth images, without its lens distortion."""
        return self._registration.depth_camera if self._registration else self.calibration.camera

    @property
    def depth_size(self) -> tuple[int, int]:
        """Return (width, height) that depth images must have."""
        return self.depth_camera.width, self.depth_camera.height

    def __call__(self, color: Image, depth_m: Image) -> tuple[Image, Image]:
        """Return colour [H, W, 3] and depth [H, W] of `camera` from the recorded ones."""
        return self._color_lens.color(color) if self._color_lens else color, self.depth(depth_m)

    def depth(self, depth_m: Image) -> Image:
        """Return depth [H, W] of `camera` from recorded depth."""
        depth_m = self.without_lens(depth_m)
        if self.beyond_m < np.inf:
            depth_m = np.where(depth_m < self.beyond_m, depth_m, np.float32(0.0))
        if self.ray_lengths is not None:
            depth_m = depth_m / self.ray_lengths
        return self._registration(depth_m) if self._registration else depth_m

    def without_lens(self, depth_m: Image) -> Image:
        """Return recorded depth without lens distortion, its values as they are."""
        return self._depth_lens.depth(depth_m) if self._depth_lens else depth_m


def check_image_sizes(
    rectification: Rectification, color: Path, color_size: tuple[int, ...], depth: Path, depth_size: tuple[int, ...]
) -> None:
    """Raise SourceError if the (width, height) of an image is not that of its camera."""
    c = rectification.calibration.camera
    if tuple(color_size) != tuple(depth_size) and not rectification.moves_depth:
        raise SourceError(
            f"{color} is {color_size[0]}×{color_size[1]} but {depth} is {depth_size[0]}×{depth_size[1]}; "
            f"{turned_by_tag(color, color_size, depth_size)}"
            "register depth to colour at the same size, or give depth_camera in calibration.json"
        )
    for what, path, size, wanted in (
        ("colour", color, color_size, (c.width, c.height)),
        ("depth", depth, depth_size, rectification.depth_size),
    ):
        if tuple(size) != wanted:
            raise SourceError(
                f"{path} is {size[0]}×{size[1]} but the calibration is for {wanted[0]}×{wanted[1]}; "
                f"{turned_by_tag(color, color_size, wanted)}"
                f"take images of that size, or correct the calibration of the {what} camera"
            )


def turned_by_tag(path: Path, size: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    """Return the likely remedy if an EXIF tag exchanges width and height of an image; empty for others."""
    if tuple(size) != tuple(wanted)[::-1] or not (turned := color_origins(path).get("orientation")):
        return ""
    return f"colour is {turned.value}: turn depth alike, or delete the tag (exiftool -Orientation= {path.parent}); or "


def _undistortion(camera: Camera, coefficients: tuple[float, ...] | None) -> Undistortion | None:
    return Undistortion(camera, np.array(coefficients)) if coefficients else None
