"""The pinhole camera: x right, y down, z forward, pixel centres at integer coordinates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole: image size in pixels, focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if self.width < 1 or self.height < 1 or not np.isfinite(numbers).all() or self.fx <= 0 or self.fy <= 0:
            raise ConfigError(f"not a camera: {self} (sizes and focal lengths must be positive and finite)")

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

    def rays(self) -> NDArray[np.float32]:
        """Return the point at depth 1 m on each pixel's ray [H, W, 3], camera frame; multiply by depth for the
        surface."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], -1).astype(np.float32)
