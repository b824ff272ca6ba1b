"""Halve and align images on a CUDA device (native/cuda/align.cu), with the same values as on the CPU.

All steps of an alignment are launched at once, and the host waits only at the end. CPU and CUDA share the source code
of the arithmetic (native/align_pixel.h, align_loop.h).
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import (
    NORMAL_TERMS,
    AlignedPose,
    AlignRules,
    ImageKernels,
    LevelPlanes,
    Matrix,
    Plane,
    Target,
    View,
    luma,
)
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.cubins import ALIGNING

CELL = 16
"""Width and height of a cell in pixels; one block of threads processes one cell (native/align_pixel.h)."""
MOTIONS = 13
"""Maximum number of motions that one launch linearises."""
READOUTS = 18
"""Numbers of the readouts of both images (native/align_level.h)."""
PINHOLE = np.dtype([("size", "i4", 2), ("intrinsics", "f4", 4)])
LOOP = np.dtype(
    [
        ("iterations", "i4"), ("update_stop", "f8"), ("plateau_stop", "f8"), ("depth_m", "f8"),
        ("degenerate_share", "f8"), ("min_pixels", "f8"),
    ],
    align=True,
)  # fmt: skip
DESCENT = np.dtype(
    [
        ("T", "f8", 12), ("sums", "f8", 5), ("best_T", "f8", 12), ("best_sums", "f8", 5), ("best", "f8"),
        ("previous", "f8"), ("last_b", "f8", 6), ("last_update", "f8", 6), ("longer", "f8"), ("gain", "f8"),
        ("level", "i4"), ("taken", "i4"), ("steps", "i4"), ("degenerate", "i4"),
    ],
    align=True,
)  # fmt: skip
STATE = np.dtype([("loop", LOOP), ("descent", DESCENT), ("readings", "f8")], align=True)
"""Structs of native/align_level.h, align_loop.h and align.cu."""


class CudaLevel:
    """One level of two images to align, and the weights of its residuals, like `_core.Level` on the CPU.

    Planes [H, W], float32, on one device; weights and noise may be None. Raises ValueError if shapes, types or devices
    differ.
    """

    def __init__(
        self, reference_gray: Tensor, reference_depth: Tensor, weight_gray: Tensor | None, weight_depth: Tensor | None,
        live_gray: Tensor, live_depth: Tensor, intrinsics: Sequence[float], options: Sequence[float],
        noise: Tensor | None = None, color_depth: Tensor | None = None, readouts: Sequence[float] = (),
    ) -> None:  # fmt: skip
        live = live_gray, live_depth
        self.planes = (reference_gray, reference_depth, weight_gray, weight_depth, *live, noise, color_depth)
        given = [plane for plane in self.planes if plane is not None]
        if len({(p.shape, p.dtype, p.device) for p in given}) > 1 or reference_gray.dtype != torch.float32:
            raise ValueError("the planes of a level are float32, of one size, on one device")
        height, width = reference_gray.shape
        self.pinhole = np.array(((width, height), intrinsics), PINHOLE)
        self.options = np.array(options, np.float32)
        self.readouts = np.array(readouts if len(readouts) else np.zeros(READOUTS), np.float32), len(readouts) > 0
        self.cells = -(-width // CELL) * -(-height // CELL)
        self.device = reference_gray.device

    def normal_equations(self, motions: Matrix, whole: int) -> Matrix:
        """Linearise at T_live_reference [n, 4, 4], n ≤ `MOTIONS`; from number `whole` on, by fewer rows. Returns
        rows of H, b, counts, S and grays, [n, 55]. The host waits."""
        n, given = len(motions), np.zeros((MOTIONS, 12))
        given[:n] = motions[:, :3].reshape(n, 12)
        of_cells, arrived = _workspace(n, self.cells, self.device)
        found = torch.empty(n, NORMAL_TERMS, dtype=torch.float64, device=self.device)
        cuda_launch.launcher_for(self.device)(
            ALIGNING, "normal_equations", n * self.cells, self.planes, self.pinhole, self.options,
            *self.readouts, given, whole, of_cells, arrived, found,
        )  # fmt: skip
        return np.asarray(found.cpu().numpy())


def _workspace(motions: int, cells: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Allocate the sums of all cells, and the counter of blocks that have stored their sums."""
    of_cells = torch.empty(motions * cells, NORMAL_TERMS, dtype=torch.float64, device=device)
    return of_cells, torch.zeros(motions, dtype=torch.int32, device=device)


def normal_equations(level: LevelPlanes, motions: Sequence[Matrix], whole: int) -> Matrix:
    """Implement `ImageKernels.normal_equations`. The host waits once."""
    return CudaLevel(*level).normal_equations(np.stack(motions), whole)


def align(planes: Sequence[LevelPlanes], readings: Tensor, T_live_reference: Matrix, rules: AlignRules) -> AlignedPose:
    """Align from the coarsest level (the last one) to the finest. The host waits once.

    All steps are launched; the steps of a level that has converged do nothing.
    """
    device, r, levels = readings.device, rules, [CudaLevel(*level) for level in planes]
    loop = (r.iterations, r.update_stop, r.plateau_stop, 0.0, r.degenerate_share, r.min_pixels)
    launch, guess = cuda_launch.launcher_for(device), np.array(T_live_reference[:3], np.float64)
    state = torch.empty(STATE.itemsize // 8, dtype=torch.float64, device=device)
    of_cells, arrived = _workspace(1, max(level.cells for level in levels), device)
    launch(ALIGNING, "begin_alignment", 1, state, np.array(loop, LOOP), guess, len(levels), readings)
    for number, level in reversed(list(enumerate(levels))):
        given = (level.planes, level.pinhole, level.options, *level.readouts, number, state, of_cells, arrived)
        for _ in range(r.iterations):
            launch(ALIGNING, "take_align_step", level.cells, *given)
    return _pose_of(state.cpu().numpy().view(STATE)[0])


def _pose_of(state: np.void) -> AlignedPose:
    d, T = state["descent"], np.eye(4)
    T[:3] = d["T"].reshape(3, 4)
    steps, degenerate = int(d["steps"]), int(d["degenerate"])
    given = float(state["loop"]["depth_m"]), float(state["readings"])
    return AlignedPose(T, d["sums"], steps, degenerate, *given, float(d["gain"]))


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
        ALIGNING, "halve_images", cuda_launch.blocks_for(size[0] * size[1]), averaged, (halves[0], halves[1]), depth,
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


def _to_host(plane: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = plane.cpu().numpy()
    return array


CUDA_IMAGES = ImageKernels(
    Tensor.contiguous, _to_host, lambda array, plane: torch.from_numpy(array).to(plane.device), lambda plane: plane,
    halve, readings_of, align, normal_equations,
)  # fmt: skip
