"""Halve images on a CUDA device (native/cuda/align.cu), to the same values as on the CPU; the host does not wait."""

import torch
from torch import Tensor

from sigmasplat.native.cuda.cubins import ALIGNING
from sigmasplat.render.cuda import launch as cuda_launch
from sigmasplat.render.cuda.launch import blocks_for

Half = Tensor | None


def halve(averaged: tuple[Half, Half], depth: Half = None) -> tuple[Half, Half, Half]:
    """Halve up to three images [H, W] of one size: two averaged over 2×2 cells, and a depth where it is one surface.

    What is None stays None. Odd sizes drop their last row or column.
    """
    given = (*averaged, depth)
    one = next(image for image in given if image is not None)
    height, width = one.shape
    size = (height // 2, width // 2)
    halves = [None if image is None else torch.empty(size, device=one.device) for image in given]
    cuda_launch.launcher_for(one.device)(
        ALIGNING, "halve_images", blocks_for(size[0] * size[1]), averaged, (halves[0], halves[1]), depth,
        halves[2], width, height,
    )  # fmt: skip
    return halves[0], halves[1], halves[2]


def readings_of(finest: Tensor, coarsest: Tensor) -> Tensor:
    """Return the mean depth of the coarsest of a pyramid's depths, metres (1 where nothing is read), and how many
    pixels of the finest have a reading, float64 [2]."""
    read = coarsest > 0
    n = read.sum()
    mean = torch.where(read, coarsest, 0.0).double().sum() / n.clamp(min=1)
    return torch.stack([torch.where(n > 0, mean, 1.0), (finest > 0).sum().double()])
