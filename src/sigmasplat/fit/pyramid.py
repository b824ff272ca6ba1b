"""Make image pyramids for coarse-to-fine alignment."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sigmasplat.data.camera import Camera
from sigmasplat.data.readout import Readout, depth_of_color
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.interface import DEPTH_STEP_M, ImageKernels, Plane
from sigmasplat.types import Matrix

LEVELS = 4
NOISE_PER_M = 0.003
"""Standard deviation of the depth readings of a structured-light sensor, times z² (Khoshelham & Elberink 2012)."""
HIDDEN_M = 1000.0
"""Depth of live pixels where something in front hides the scene. Alignment takes them for another surface at every
level, and uses neither their depth nor their colour."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first; weights of both; cameras.

    backend: its image kernels halve and align the planes. Only the planes of CUDA are not in host memory.
    scene_scale: size of the scene relative to a room (`render.scene_scale`); noise_per_m: standard deviation of depth
    readings, times z² (`render.depth_noise_per_m`); noise: σ of each reading relative to that law, None: all follow it;
    confidence: how many times as sure readings are as that law, at the distance of a wall; readout: None: all rows were
    read at once; color_depths: of `color_depth`, by width.
    """

    gray: list[Plane]
    depth: list[Plane]
    weight: list[Plane | None]
    weight_depth: list[Plane | None]
    cameras: list[Camera]
    noise: list[Plane | None]
    backend: str = "cpu"
    scene_scale: float = 1.0
    noise_per_m: float = NOISE_PER_M
    confidence: float = 1.0
    readout: Readout | None = None
    color_depths: dict[int, Plane] = field(default_factory=dict)

    @property
    def kernels(self) -> ImageKernels:
        """Return the kernels that halve and align the planes."""
        return fits_of(self).images

    @cached_property
    def readings(self) -> Any:
        """Return the mean depth of the coarsest level in metres (1 without readings), and how many pixels of the finest
        level have a reading, float64 [2], on the planes' device."""
        return self.kernels.readings_of(self.depth[0], self.depth[-1])

    @property
    def points(self) -> Matrix:
        """Return the points [P, 3] that the coarsest size shows, m, in the axes of the camera: of 40 to 79 columns, if
        it has so many."""
        step = max(1, self.cameras[-1].width // 40)
        depth_m: Matrix = np.asarray(self.kernels.to_host(self.depth[-1])[::step, ::step], np.float64)[..., None]
        return np.asarray((self.cameras[-1].rays()[::step, ::step] * depth_m)[depth_m[..., 0] > 0])

    def weighed(self, weight: Plane | None, weight_depth: Plane | None = None) -> "Pyramid":
        """Return the same images with other weights [H, W] of gray and depth; without one for depth, gray's is used."""
        given = (None if w is None else self.kernels.contiguous(w) for w in (weight, weight_depth))
        gray_weights, depth_weights = ([w] for w in given)
        for _ in self.cameras[1:]:
            on_gray, on_depth, _ = self.kernels.halve((gray_weights[-1], depth_weights[-1]), None, DEPTH_STEP_M)
            gray_weights.append(on_gray)
            depth_weights.append(on_depth)
        own = gray_weights if weight_depth is None else depth_weights
        return replace(self, weight=gray_weights, weight_depth=own)

    def coarse(self, levels: int) -> "Pyramid":
        """Return the coarsest `levels` sizes, for a quick alignment."""
        return self._sizes(slice(max(0, len(self.cameras) - levels), None))

    def half(self) -> "Pyramid":
        """Return half of the size alone."""
        return self._sizes(slice(1, 2))

    def finest(self) -> "Pyramid":
        """Return the finest size alone, for an alignment that coarse sizes cannot pull away."""
        return self._sizes(slice(1))

    def read(self, readout: Readout | None) -> "Pyramid":
        """Return the same images, with when their rows were read."""
        return self if readout is self.readout else replace(self, readout=readout, color_depths={})

    def noisier(self, factor: float) -> "Pyramid":
        """Return the same images, with this many times as much noise of depth."""
        return self if factor == 1.0 else replace(self, noise_per_m=factor * self.noise_per_m)

    def color_depth(self, k: int) -> Plane | None:
        """Return the depth [H, W] of what the pixels of a level show in colour; None: colour and depth were read at the
        same time."""
        if self.readout is None:
            return None
        c = self.cameras[k]
        if c.width not in self.color_depths:
            seen_m = depth_of_color(c, self.kernels.to_host(self.depth[k]), self.readout)
            self.color_depths[c.width] = self.kernels.beside(seen_m, self.depth[k])
        return self.color_depths[c.width]

    def _sizes(self, which: slice) -> "Pyramid":
        return replace(
            self, gray=self.gray[which], depth=self.depth[which], weight=self.weight[which],
            weight_depth=self.weight_depth[which], cameras=self.cameras[which], noise=self.noise[which],
        )  # fmt: skip

    def hiding(self, hidden: Any) -> "Pyramid":
        """Return the same images for comparisons and quick fits that leave out these pixels [H, W] of the finest size:
        each level has `HIDDEN_M` there."""
        levels = []
        for depth in self.depth:
            host = self.kernels.to_host(depth)
            step = len(hidden) // len(host)  # sizes halve, and drop an odd last row
            coarse = hidden[::step, ::step][: host.shape[0], : host.shape[1]]
            levels.append(self.kernels.beside(np.where(coarse, np.float32(HIDDEN_M), host), depth))
        return replace(self, depth=levels, color_depths={})

    def with_depth(self, depth_m: Any) -> "Pyramid":
        """Return the same gray images with other depth [H, W], m, which is on the host."""
        depth = [self.kernels.beside(np.ascontiguousarray(depth_m, np.float32), self.depth[0])]
        for _ in self.cameras[1:]:
            depth.append(self.kernels.halve((None, None), depth[-1], DEPTH_STEP_M * self.scene_scale)[2])
        return replace(self, depth=depth, color_depths={})

    @staticmethod
    def of(
        gray: Plane, depth_m: Plane, camera: Camera, weight: Plane | None = None, levels: int = LEVELS,
        backend: str = "cpu", scene_scale: float = 1.0, noise_per_m: float = NOISE_PER_M, noise: Plane | None = None,
        confidence: float = 1.0,
    ) -> "Pyramid":  # fmt: skip
        """Build a pyramid of at most `levels` sizes from gray [H, W], depth [H, W] and an optional weight [H, W] and
        noise [H, W]."""
        p = Pyramid([], [], [None], [None], [camera], [noise], backend, scene_scale, noise_per_m, confidence)
        p.gray.append(p.kernels.contiguous(gray))
        p.depth.append(p.kernels.contiguous(depth_m))
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            half_gray, half_noise, half_depth = p.kernels.halve(
                (p.gray[-1], p.noise[-1]), p.depth[-1], DEPTH_STEP_M * scene_scale
            )
            p.gray.append(half_gray)
            p.depth.append(half_depth)
            p.noise.append(half_noise)
            # With odd sizes the last row or column is dropped, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p.weighed(weight)
