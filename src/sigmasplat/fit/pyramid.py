"""Halve images again and again: what alignment works on, coarse to fine."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel
from torch import Tensor

from sigmasplat.fit.cuda import pyramid as cuda_pyramid
from sigmasplat.model.camera import Camera

Image = NDArray[np.float32]
Plane = Image | Tensor
"""An image on the CPU, or a float32 tensor on the CUDA device that is to align it."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
LEVELS = 4


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first; weights of both; cameras.

    Its planes are arrays, or tensors on the CUDA device that aligns them.
    """

    gray: list[Plane]
    depth: list[Plane]
    weight: list[Plane | None]
    weight_depth: list[Plane | None]
    cameras: list[Camera]

    @property
    def on_device(self) -> bool:
        """Tell whether the planes are tensors on a device, to be aligned there."""
        return isinstance(self.gray[0], Tensor)

    @cached_property
    def readings(self) -> "NDArray[np.float64] | Tensor":
        """Return the mean depth of the coarsest level, metres (1 where nothing is read), and how many pixels of the
        finest have a reading, float64 [2], where the planes lie."""
        fine, coarse = self.depth[0], self.depth[-1]
        if isinstance(fine, Tensor) and isinstance(coarse, Tensor):
            return cuda_pyramid.readings_of(fine, coarse)
        read = coarse[coarse > 0]
        return np.array([float(read.mean()) if len(read) else 1.0, float((fine > 0).sum())])

    def weighed(self, weight: Plane | None, weight_depth: Plane | None = None) -> "Pyramid":
        """Return the same images with other weights [H, W] of gray and depth; depth's is gray's where none is given."""
        gray_weights, depth_weights = ([None if w is None else _whole(w)] for w in (weight, weight_depth))
        for _ in self.cameras[1:]:
            halves = _averaged(gray_weights[-1], depth_weights[-1])
            gray_weights.append(halves[0])
            depth_weights.append(halves[1])
        own = gray_weights if weight_depth is None else depth_weights
        return Pyramid(self.gray, self.depth, gray_weights, own, self.cameras)

    @staticmethod
    def of(gray: Plane, depth_m: Plane, camera: Camera, weight: Plane | None = None, levels: int = LEVELS) -> "Pyramid":
        """Halve gray [H, W], depth [H, W] and an optional weight [H, W] until `levels` sizes exist."""
        p = Pyramid([_whole(gray)], [_whole(depth_m)], [None], [None], [camera])
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            half_gray, half_depth = _halved(p.gray[-1], p.depth[-1])
            p.gray.append(half_gray)
            p.depth.append(half_depth)
            # Odd sizes drop their last row or column, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p.weighed(weight)


def _whole(plane: Plane) -> Plane:
    """Return a plane whose rows follow each other without gaps."""
    return plane.contiguous() if isinstance(plane, Tensor) else np.ascontiguousarray(plane)


def _halved(gray: Plane, depth: Plane) -> tuple[Plane, Plane]:
    """Halve an image and its depth, where they lie."""
    if isinstance(gray, Tensor) and isinstance(depth, Tensor):
        half_gray, _, half_depth = cuda_pyramid.halve((gray, None), depth)
        assert half_gray is not None and half_depth is not None
        return half_gray, half_depth
    assert not isinstance(gray, Tensor) and not isinstance(depth, Tensor), "both planes lie in one place"
    return _quarter(gray).mean(0), _half_depth(depth)


def _averaged(one: Plane | None, other: Plane | None) -> tuple[Plane | None, Plane | None]:
    """Average two weights over 2×2 cells, where they lie; None stays None."""
    first, second = (weight if isinstance(weight, Tensor) else None for weight in (one, other))
    if first is not None or second is not None:
        return cuda_pyramid.halve((first, second))[:2]
    halves = [None if w is None or isinstance(w, Tensor) else _quarter(w).mean(0) for w in (one, other)]
    return halves[0], halves[1]


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


def luma(color: Tensor) -> Tensor:
    """Do the same with planes [3, H, W], wherever they lie."""
    red, green, blue = map(float, LUMA)
    gray: Tensor = red * color[0] + green * color[1] + blue * color[2]
    return gray


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
