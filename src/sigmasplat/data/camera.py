"""The pinhole camera: x right, y down, z forward, pixel centres at integer coordinates; the exposure of its images.

recorded colour = gain · colour of the map + offset. An exposure is an array [3, 2]: (gain, offset) of each channel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import ConfigError
from sigmasplat.types import Matrix


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole: image size in pixels, focal lengths and principal point in pixels. Raises ConfigError
    for numbers that no camera has: an angle of view above 179.8°, or below 0.2", or a centre that far outside."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        both = (self.width, self.fx, self.cx), (self.height, self.fy, self.cy)
        if not all(n >= 1 and 1e-3 * n <= f <= 1e6 * n and abs(c) <= 1e6 * n for n, f, c in both):
            raise ConfigError(f"not a camera: {self} (sizes and focal lengths must be positive and plausible)")

    @property
    def width_rad(self) -> float:
        """Return the horizontal angle of view, if the principal point is in the middle."""
        return 2.0 * float(np.arctan(self.width / (2.0 * self.fx)))

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same view sampled at another size. The corner (−½, −½) stays fixed."""
        if (width, height) == (self.width, self.height):
            return self
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5)

    def prepared(self, width: int, crop_px: int = 0) -> "Camera":
        """Return the camera of the working images: `width` pixels wide (0 = unchanged), height in proportion, then
        cropped by `crop_px` pixels at every edge. Raises ConfigError if no pixel would remain."""
        c = self.resized(width, round(self.height * width / self.width)) if width else self
        if 2 * crop_px >= min(c.width, c.height):
            raise ConfigError(
                f"input.crop_px is {crop_px}, which removes the whole image of {c.width}×{c.height}; "
                "give a smaller value"
            )
        return Camera(c.width - 2 * crop_px, c.height - 2 * crop_px, c.fx, c.fy, c.cx - crop_px, c.cy - crop_px)

    def share_seen_by(self, other: "Camera") -> float:
        """Return the share of this camera's image, in [0, 1], that another camera at the same pose also sees."""
        columns, rows = self.pixels_in(other)
        return float(np.mean(_inside(columns, other.width)) * np.mean(_inside(rows, other.height)))

    def pixels_in(self, other: "Camera") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the columns [width] and rows [height] of this camera's pixels in the image of another camera at the
        same pose. The depth of a point is the same in both."""
        columns = (np.arange(self.width, dtype=np.float64) - self.cx) * (other.fx / self.fx) + other.cx
        rows = (np.arange(self.height, dtype=np.float64) - self.cy) * (other.fy / self.fy) + other.cy
        return columns, rows

    def rays(self) -> NDArray[np.float32]:
        """Return the point at depth 1 m on each pixel's ray [H, W, 3], camera frame; times depth it is the surface."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)

    def ray_lengths(self) -> NDArray[np.float32]:
        """Return the length of each of the `rays`, [H, W]: distance along a ray divided by it is depth."""
        x, y = (np.arange(self.width) - self.cx) / self.fx, (np.arange(self.height) - self.cy) / self.fy
        return np.asarray(np.sqrt(1.0 + x * x + (y * y)[:, None]), np.float32)


def _inside(pixels: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """Return which of the coordinates are on an image with `count` pixels."""
    return (pixels >= -0.5) & (pixels <= count - 0.5)


Floats = NDArray[np.float32]

NEUTRAL: Matrix = np.array([[1.0, 0.0]] * 3)
"""The exposure of an image whose colours are those of the map."""


def gray_exposure(a: float, b: float) -> Matrix:
    """Return the exposure exp(a) · colour + b, the same for each channel, as tracking fits it."""
    return np.array([[np.exp(a), b]] * 3)


def exposed(color: Floats, exposure: Matrix) -> Floats:
    """Return colours [..., 3] of the map, in [0, 1], as an image with this exposure records them."""
    gain, offset = exposure.astype(np.float32).T
    return np.asarray(np.clip(color * gain + offset, 0.0, 1.0), np.float32)


def unexposed(color: Floats, exposure: Matrix) -> Floats:
    """Return recorded colours [..., 3], in [0, 1], in the exposure of the map."""
    gain, offset = exposure.astype(np.float32).T
    return np.asarray(np.clip((color - offset) / gain, 0.0, 1.0), np.float32)


def between(frames: NDArray[np.integer], exposures: Matrix, at: NDArray[np.integer]) -> Matrix:
    """Return the exposures [M, 3, 2] at frame numbers `at` [M], interpolated between those of `frames` [K], which must
    ascend; before the first and after the last frame theirs are used. exposures [K, 3, 2]; neutral without frames."""
    if not len(frames):
        return np.tile(NEUTRAL, (len(at), 1, 1))
    columns = [np.interp(at, frames, column) for column in exposures.reshape(len(frames), 6).T]
    return np.stack(columns, -1).reshape(-1, 3, 2)


def centred(exposures: Matrix) -> Matrix:
    """Return exposures [K, 3, 2] relative to their mean: the geometric mean of the gains, the mean of the offsets.

    Only differences between images can be observed; without a fixed mean, the map's colours would drift.
    """
    gain, offset = np.exp(np.log(exposures[..., 0]).mean(0)), exposures[..., 1].mean(0)
    relative = exposures[..., 0] / gain
    return np.stack([relative, exposures[..., 1] - relative * offset], -1)
