"""Halve and align images in host memory with the compiled CPU kernels (native/resize.h, native/align.h)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sigmasplat.fit.gray import Image, gray_of
from sigmasplat.fit.interface import DEPTH_STEP_M, NORMAL_TERMS, AlignedPose, AlignRules, ImageKernels, LevelPlanes
from sigmasplat.fit.target import Target
from sigmasplat.native import kernels
from sigmasplat.render.backend import backend_module
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.native import _core

Half = Image | None


def halve(averaged: tuple[Half, Half], depth: Half, step_m: float) -> tuple[Half, Half, Half]:
    """Implement `ImageKernels.halve`."""
    first, second = (None if image is None else halved(image) for image in averaged)
    return first, second, None if depth is None else halved_depth(depth, step_m)


def halved(image: Image) -> Image:
    """Return the mean of each 2×2 cell of an image [H, W], as [H/2, W/2]."""
    core = kernels()
    if core is None:
        return halved_in_numpy(image)
    half = np.empty((image.shape[0] // 2, image.shape[1] // 2), np.float32)
    core.halve(image, half)
    return half


def halved_depth(depth: Image, step_m: float = DEPTH_STEP_M) -> Image:
    """Average the readings of 2×2 cells. A cell gets no reading if it has a single one or contains a depth step."""
    core = kernels()
    if core is None:
        return halved_depth_in_numpy(depth, step_m)
    half = np.empty((depth.shape[0] // 2, depth.shape[1] // 2), np.float32)
    core.halve_depth(depth, step_m, half)
    return half


def halved_in_numpy(image: Image) -> Image:
    """Return the same bytes as `halved`, also where the kernels are not built."""
    return np.asarray(_quarter(image).mean(0))


def halved_depth_in_numpy(depth: Image, step_m: float = DEPTH_STEP_M) -> Image:
    """Return the same bytes as `halved_depth`, also where the kernels are not built."""
    cells = _quarter(depth)
    readings = (cells > 0).sum(0, dtype=np.float32)
    near, far = np.where(cells > 0, cells, np.float32(np.inf)).min(0), cells.max(0)
    mean = cells.sum(0) / np.maximum(readings, 1)
    return np.where((readings > 1) & (far - near < step_m), mean, np.float32(0.0))


def _quarter(image: Image) -> Image:
    """Return the four pixels of each 2×2 cell, stacked as [4, H/2, W/2]."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[0:h:2, 0:w:2], image[0:h:2, 1:w:2], image[1:h:2, 0:w:2], image[1:h:2, 1:w:2]])


def readings_of(finest: Image, coarsest: Image) -> Matrix:
    """Implement `ImageKernels.readings_of`."""
    read = coarsest[coarsest > 0]
    return np.array([float(read.mean()) if len(read) else 1.0, float((finest > 0).sum())])


def align(levels: Sequence[LevelPlanes], readings: Matrix, T_live_reference: Matrix, rules: AlignRules) -> AlignedPose:
    """Align from the coarsest level (the last one) to the finest, in one call of the kernels.

    Raises BackendError if the kernels are not built.
    """
    backend_module("cpu")  # raises BackendError if the kernels are not built
    from sigmasplat.native import _core

    (depth_m, n), T, sums = readings.tolist(), np.array(T_live_reference, np.float64), np.zeros(5)
    r = rules
    steps, degenerate = _core.align_images(
        [_laid_out(level) for level in levels], r.iterations, r.update_stop, r.plateau_stop, depth_m,
        r.degenerate_share, r.min_pixels, T, sums,
    )  # fmt: skip
    return AlignedPose(T, sums, steps, degenerate, depth_m, n)


def normal_equations(level: LevelPlanes, motions: Sequence[Matrix]) -> Matrix:
    """Implement `ImageKernels.normal_equations`."""
    from sigmasplat.native import _core

    rows, laid_out = np.zeros((len(motions), NORMAL_TERMS)), _laid_out(level)
    for row, T in zip(rows, motions, strict=True):
        _core.align_step(laid_out, T, row[:21], row[21:27], row[32:], row[27:32])
    return rows


def _laid_out(level: LevelPlanes) -> "_core.Level":
    from sigmasplat.native import _core

    planes: tuple[Any, ...] = level
    return _core.Level(*planes)


def live_planes(view: View, color: Image, depth_m: Image, target: Target) -> tuple[Image, Image]:
    """Return gray and depth [H, W] of a frame."""
    return gray_of(color), depth_m


def _beside(array: Image, plane: Image) -> Image:
    return array


CPU_IMAGES = ImageKernels(
    np.ascontiguousarray, np.asarray, _beside, torch.tensor, halve, readings_of, align, normal_equations
)
