"""Halve images on a CUDA device (native/cuda/align.cu), with the same values as on the CPU; the host does not wait."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import ImageKernels, Plane, Target, View, luma
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.align import align, normal_equations
from sigmasplat.plugins.cuda.cubins import ALIGNING
from sigmasplat.plugins.cuda.launch import blocks_for

Half = Tensor | None


def halve(averaged: tuple[Half, Half], depth: Half, step_m: float) -> tuple[Half, Half, Half]:
    """Implement `ImageKernels.halve`."""
    given = (*averaged, depth)
    one = next((image for image in given if image is not None), None)
    if one is None:
        return None, None, None
    height, width = one.shape
    size = (height // 2, width // 2)
    halves = [None if image is None else torch.empty(size, device=one.device) for image in given]
    cuda_launch.launcher_for(one.device)(
        ALIGNING, "halve_images", blocks_for(size[0] * size[1]), averaged, (halves[0], halves[1]), depth,
        halves[2], step_m, width, height,
    )  # fmt: skip
    return halves[0], halves[1], halves[2]


def readings_of(finest: Tensor, coarsest: Tensor) -> Tensor:
    """Implement `ImageKernels.readings_of`; the result stays on the device."""
    read = coarsest > 0
    n = read.sum()
    mean = torch.where(read, coarsest, 0.0).double().sum() / n.clamp(min=1)
    return torch.stack([torch.where(n > 0, mean, 1.0), (finest > 0).sum().double()])


def live_planes(view: View, color: Plane, depth_m: Plane, target: Target) -> tuple[Tensor, Tensor]:
    """Return gray and depth [H, W] of a frame on the view's device, from the copy of the target on that device."""
    on_device, (h, w) = target.to(view.sums.device), depth_m.shape
    return luma(on_device.color[:, :h, :w]), on_device.depth_image


def _contiguous(plane: Tensor) -> Tensor:
    return plane.contiguous()


def _to_host(plane: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = plane.cpu().numpy()
    return array


def _beside(array: NDArray[np.float32], plane: Tensor) -> Tensor:
    return torch.from_numpy(array).to(plane.device)


def _as_tensor(plane: Tensor) -> Tensor:
    return plane


CUDA_IMAGES = ImageKernels(_contiguous, _to_host, _beside, _as_tensor, halve, readings_of, align, normal_equations)
