"""Halve images again and again: what alignment works on, coarse to fine."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.interface import ImageKernels, Plane
from sigmasplat.model.camera import Camera

LEVELS = 4


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first; weights of both; cameras.

    backend: whose image kernels halve and align the planes; only CUDA's are not in the host's memory.
    """

    gray: list[Plane]
    depth: list[Plane]
    weight: list[Plane | None]
    weight_depth: list[Plane | None]
    cameras: list[Camera]
    backend: str = "cpu"

    @property
    def kernels(self) -> ImageKernels:
        """Return what halves and aligns the planes."""
        return fits_of(self).images

    @cached_property
    def readings(self) -> Any:
        """Return the mean depth of the coarsest level, metres (1 where nothing is read), and how many pixels of the
        finest have a reading, float64 [2], where the planes are."""
        return self.kernels.readings_of(self.depth[0], self.depth[-1])

    def weighed(self, weight: Plane | None, weight_depth: Plane | None = None) -> "Pyramid":
        """Return the same images with other weights [H, W] of gray and depth; depth's is gray's where none is given."""
        given = (None if w is None else self.kernels.contiguous(w) for w in (weight, weight_depth))
        gray_weights, depth_weights = ([w] for w in given)
        for _ in self.cameras[1:]:
            on_gray, on_depth, _ = self.kernels.halve((gray_weights[-1], depth_weights[-1]), None)
            gray_weights.append(on_gray)
            depth_weights.append(on_depth)
        own = gray_weights if weight_depth is None else depth_weights
        return Pyramid(self.gray, self.depth, gray_weights, own, self.cameras, self.backend)

    @staticmethod
    def of(
        gray: Plane,
        depth_m: Plane,
        camera: Camera,
        weight: Plane | None = None,
        levels: int = LEVELS,
        backend: str = "cpu",
    ) -> "Pyramid":
        """Halve gray [H, W], depth [H, W] and an optional weight [H, W] until `levels` sizes exist."""
        p = Pyramid([], [], [None], [None], [camera], backend)
        p.gray.append(p.kernels.contiguous(gray))
        p.depth.append(p.kernels.contiguous(depth_m))
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            half_gray, _, half_depth = p.kernels.halve((p.gray[-1], None), p.depth[-1])
            p.gray.append(half_gray)
            p.depth.append(half_depth)
            # Odd sizes drop their last row or column, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p.weighed(weight)
