"""Bin and blend on CUDA, and keep the buffers for the backward pass. torch provides memory, sorting and sums.

The number of (tile, splat) pairs is known only on the device. After the first image, memory for the expected number is
allocated, so the host does not wait during a forward pass. If an image has more pairs than expected, `blend` processes
all splats instead of lists: the result is the same, but slower. The backward pass then knows the number and lists the
pairs again. Loops that must run without the host use `within`, which never allocates more memory; `pairs` says on the
device whether all pairs fitted.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import BackendError, Camera, RenderConfig
from sigmasplat.plugins.cuda.cubins import FEATURE_COUNTS, FITTING
from sigmasplat.plugins.cuda.launch import Argument, HostCopy, Launcher, Struct, blocks_for

TILE = 16
GEOMETRY = 8
"""Number of floats in a splat's row before its features (native/cuda/device.cuh)."""
MOMENTS = 6
"""Number of sums in a record before those of the features (native/cuda/gradients.cuh)."""
RAY_MOMENT_AT, RAY_MOMENT_SUMS = 16, 9
"""With depth along the ray: where the sums of the moment begin in a record, and their number."""
SPARE = 1.25
"""Memory is allocated for this multiple of the number of pairs in the last image."""
MOST_PAIRS = 2**31 - 1


class Planes(NamedTuple):
    """The output planes, as the kernels' `Planes`: sums [K, H, W], the others [H, W], None if not requested."""

    sums: Tensor
    moment: Tensor | None
    alpha: Tensor
    median_id: Tensor | None = None
    median_weight: Tensor | None = None
    dominant_id: Tensor | None = None
    dominant_weight: Tensor | None = None
    median_depth: Tensor | None = None


def program_for(features: int) -> int:
    """Return the feature count of the program that blends this many features."""
    return next(count for count in FEATURE_COUNTS if count >= features)


class Raster:
    """The buffers of one render of n splats on a device, kept from the forward to the backward pass."""

    def __init__(self, launch: Launcher, device: torch.device, capacity: int | None = None) -> None:
        """capacity: initial number of pairs to allocate memory for; by default the host waits for the first image."""
        self._launch, self.device, self.capacity = launch, device, capacity
        self.n = 0

    def prepare(self, n: int, used: int, camera: Camera, options: RenderConfig, rays: bool = False) -> None:
        """Allocate for n splats with `used` features; rays: of a view whose depth is along the ray."""
        self.n, self.used, self.rays = n, used, rays
        features = program_for(used)
        self.features = -features if rays else features
        self.tiles_x, self.tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
        self.frame = _frame(camera, options, self.tiles_x, self.tiles_y)
        self.rows = self.empty(n, GEOMETRY + _rounded(features))
        self.boxes, self.counts = self.empty(n, 4, dtype=torch.int16), self.empty(n, dtype=torch.int32)
        self.depths, self.visible = self.empty(n), self.empty(n, dtype=torch.uint8)

    @property
    def packed(self) -> Struct:
        """Return the buffers of packed splats, as the kernels' `Packed`."""
        return self.rows, self.boxes, self.counts, self.depths, self.visible

    def empty(self, *size: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Allocate memory on the device."""
        return torch.empty(size, dtype=dtype, device=self.device)

    def launch(self, kernel: str, blocks: int, *arguments: Argument) -> None:
        """Run a kernel of the program for this render's features."""
        self._launch(self.features, kernel, blocks, *arguments)

    def launch_fit(self, kernel: str, blocks: int, *arguments: Argument) -> None:
        """Run a kernel of the fits' loops (native/cuda/fit.cu)."""
        self._launch(FITTING, kernel, blocks, *arguments)

    def each_splat(self, kernel: str, *arguments: Argument) -> None:
        """Run a kernel with a thread for each splat."""
        self.launch(kernel, blocks_for(self.n), *arguments)

    def bin(self, within: bool = False) -> None:
        """For each tile, list the packed splats that reach it, near to far; `within`: the pairs that fit into the
        allocated memory, without informing the host of their number."""
        self._order = torch.sort(self.depths, stable=True).indices
        self._ends = self.counts[self._order].cumsum(0)
        self._total = self._ends[-1:] if self.n else torch.zeros(1, dtype=torch.int64, device=self.device)

        if not within:
            self._host_total = HostCopy(self._total)
        if self.capacity is None and not within:
            self.make_room()
        else:
            self._list()

    def make_room(self) -> None:
        """List the pairs again if they did not all fit. Waits only for their number, which is known before the image.

        Raises BackendError as `expect` does.
        """
        total = int(self._host_total.read()[0])
        if self.capacity is None or total > self.capacity:
            self.expect(total)
            self._list()

    def expect(self, pairs: int) -> None:
        """Allocate memory for this number of pairs and a margin, from the next listing on.

        Raises BackendError if there are more pairs than can be numbered.
        """
        if pairs > MOST_PAIRS // SPARE:
            raise BackendError(f"{pairs} pairs of splats and tiles are too many; use fewer or smaller splats")
        self.capacity = int(SPARE * pairs)

    @property
    def pairs(self) -> Struct:
        """Return the number of pairs, on the device, and the number that fits, as the kernels' `Pairs`."""
        return self._total, self._room

    def _list(self) -> None:
        tiles, capacity = self.tiles_x * self.tiles_y, max(self.capacity or 0, 1)
        short = tiles < torch.iinfo(torch.int16).max
        number = torch.int16 if short else torch.int32
        tile_of = torch.full((capacity,), tiles, dtype=number, device=self.device)
        owners = torch.zeros(capacity, dtype=torch.int32, device=self.device)
        self.first_slots = self.empty(self.n, dtype=torch.int32)
        self.each_splat(
            "list_pairs_short" if short else "list_pairs_int", self._order, self._ends, self.counts, self.boxes,
            self.rows, self.n, capacity, self.frame, self.first_slots, tile_of, owners,
        )  # fmt: skip
        tile_of, self.slots = torch.sort(tile_of, stable=True)
        self._items = owners[self.slots]
        bounds = torch.arange(tiles + 1, dtype=number, device=self.device)
        self._tile_begin = torch.searchsorted(tile_of, bounds, out_int32=True)
        self._room = capacity

    @property
    def _lists(self) -> Struct:
        return self._items, self._tile_begin, self._order, self._total, self.counts, self.n, self._room

    def blend(self, planes: Planes, reference: Tensor | None) -> None:
        """Blend the listed splats into planes; `reference` [H, W] is the depth reference of the moment plane."""
        kernel = "blend" + "_moment" * (planes.moment is not None) + "_ids" * (planes.median_id is not None)
        self.launch(
            kernel, self.tiles_x * self.tiles_y, self.frame, self.rows, self._lists, reference, self.used, planes
        )

    def gradients(
        self, planes: Planes, reference: Tensor | None, on_sums: Tensor, on_moment: Tensor | None,
        on_alpha: Tensor | None,
    ) -> tuple[Tensor, int]:  # fmt: skip
        """Sum the planes' gradients over pixels, per splat. Return the records [n, R], and the position in a record of
        the moment's two sums (0 = none)."""
        self.make_room()
        end = MOMENTS + abs(self.features)
        moment = 0 if on_moment is None else RAY_MOMENT_AT if self.rays else end
        floats = _rounded(moment + (RAY_MOMENT_SUMS if self.rays else 2) if moment else end + 2 * self.rays)
        kernel = "blend_backward_moment" if moment else "blend_backward"
        outputs = Planes(planes.sums, planes.moment if moment else None, planes.alpha)
        records = self.empty(self._room, floats)
        self.launch(
            kernel, self.tiles_x * self.tiles_y, self.frame, self.rows, self._lists, self.slots, reference, self.used,
            outputs, (on_sums, on_moment, on_alpha), records,
        )  # fmt: skip
        return self._summed(records), moment

    def pose_gradients(self, planes: Planes, on_sums: Tensor, within: bool) -> Tensor:
        """Sum the gradients of colour and depth only, which are the first four planes; `within`: in the memory that
        there is, and if not all pairs fit, all sums are 0."""
        if not within:
            self.make_room()
        records = self.empty(self._room, _rounded(MOMENTS + 4 + 2 * self.rays))
        outputs = Planes(planes.sums, None, planes.alpha)
        self.launch(
            "blend_backward_pose", self.tiles_x * self.tiles_y, self.frame, self.rows, self._lists, self.slots,
            self.used, outputs, (on_sums, None, None), records,
        )  # fmt: skip
        if within:
            self.launch_fit("drop_pairs", blocks_for(self.n), self.pairs, self.n, self.counts)
        return self._summed(records)

    def _summed(self, records: Tensor) -> Tensor:
        floats = records.shape[1]
        sums = self.empty(self.n, floats)
        blocks = blocks_for(self.n * floats)
        self.launch("sum_records", blocks, records, self.first_slots, self.counts, self.n, floats, sums)
        return sums

    def twists(self) -> Tensor:
        """Allocate the pose twists [blocks, 6], one per block of a kernel."""
        return self.empty(blocks_for(self.n), 6, dtype=torch.float64)


def _rounded(floats: int) -> int:
    return -(-floats // 4) * 4


def _frame(camera: Camera, options: RenderConfig, tiles_x: int, tiles_y: int) -> NDArray[np.void]:
    """Return the kernels' `Frame` (native/cuda/device.cuh)."""
    numbers = (
        camera.width, camera.height, tiles_x, tiles_y, math.log2(options.alpha_min), options.transmittance_stop,
    )  # fmt: skip
    return np.array(numbers, dtype="i4,i4,i4,i4,f4,f4")
