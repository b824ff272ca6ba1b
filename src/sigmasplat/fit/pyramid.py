"""Halve images again and again: what alignment works on, coarse to fine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel

from sigmasplat.model.camera import Camera

Image = NDArray[np.float32]
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
LEVELS = 4


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first; weights of both; cameras."""

    gray: list[Image]
    depth: list[Image]
    weight: list[Image | None]
    weight_depth: list[Image | None]
    cameras: list[Camera]

    def weighed(self, weight: Image | None, weight_depth: Image | None = None) -> "Pyramid":
        """Return the same images with other weights [H, W] of gray and depth; depth's is gray's where none is given."""
        gray_weights = _halvings(weight, len(self.cameras))
        depth_weights = gray_weights if weight_depth is None else _halvings(weight_depth, len(self.cameras))
        return Pyramid(self.gray, self.depth, gray_weights, depth_weights, self.cameras)

    @staticmethod
    def of(gray: Image, depth_m: Image, camera: Camera, weight: Image | None = None, levels: int = LEVELS) -> "Pyramid":
        """Halve gray [H, W], depth [H, W] and an optional weight [H, W] until `levels` sizes exist."""
        p = Pyramid([np.ascontiguousarray(gray)], [np.ascontiguousarray(depth_m)], [None], [None], [camera])
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            p.gray.append(_quarter(p.gray[-1]).mean(0))
            p.depth.append(_half_depth(p.depth[-1]))
            # Odd sizes drop their last row or column, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p.weighed(weight)


def _halvings(weight: Image | None, levels: int) -> list[Image | None]:
    """Average a weight over 2×2 cells, level by level; None stays None."""
    found = [weight]
    for _ in range(levels - 1):
        last = found[-1]
        found.append(None if last is None else _quarter(last).mean(0))
    return found


def _quarter(image: Image) -> Image:
    """Stack the four pixels of each 2×2 cell, [4, H/2, W/2]."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[0:h:2, 0:w:2], image[0:h:2, 1:w:2], image[1:h:2, 0:w:2], image[1:h:2, 1:w:2]])


def _half_depth(depth: Image) -> Image:
    """Average 2×2 cells that lie on one surface; a cell with a hole or a step has no reading."""
    cells = _quarter(depth)
    near, far = cells.min(0), cells.max(0)
    return np.where((near > 0) & (far - near < 0.05), cells.mean(0), np.float32(0.0))


def gray_of(color: Image) -> Image:
    """Reduce colour [H, W, 3] to luma [H, W]."""
    return np.asarray(color @ LUMA)


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
