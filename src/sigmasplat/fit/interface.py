"""Define what the fits need from a device: one record, `DeviceFits`, one per backend in fit/backends.py."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.target import Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

Weights = Mapping[str, float]
"""Weights of the loss terms (`fit.losses`) by name."""
Twist = Matrix | Tensor
"""Gradient with respect to a pose's left twist (ρ, φ) [6]. A tensor, like a cost, may still be computed on a device."""
Plane = Any
"""An image [H, W], float32: an array in host memory, or a tensor on the device that aligns it."""


# ---- mapping ----


class Accumulator(Protocol):
    """Sums the gradient of the mean loss of several images, then steps every splat that is visible in any of them."""

    def add(self, field: GaussianField, share: float, grad2d: Tensor | None = None) -> Twist:
        """Add the view's gradient planes, weighted by their share of the mean. Return the image's pose twist [6]."""

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float | Tensor:
        """Add the gradient of the shape terms and take Adam's step. Return the cost of the shape terms."""


class MappingStep(Protocol):
    """One mapping step on a view: render, compute the gradient of the image terms, propagate it to the splats, step.

    Twists and costs may still be on a device; `DeviceFits.to_host` reads them.
    """

    @property
    def view(self) -> View:
        """Return the view that the step renders to."""

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes."""

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Twist, float | Tensor]:
        """Step the splats in view; return the pose twist [6] and the cost of the shape terms.

        The first `frozen_colors` splats keep their colours. grad2d [N]: filled as by `View.backward`.
        """

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Allocate the gradient sum of several images. Raises ConfigError if the step takes one image only."""


# ---- tracking ----


class Descent(NamedTuple):
    """The result of a descent: T_camera_world [4, 4]; exposure (a, b) of exp(a)·Ĉ + b; the first and the smallest loss;
    the number of steps."""

    T_camera_world: Matrix
    exposure: tuple[float, float]
    first_loss: float
    loss: float
    steps: int


class ReferenceMaps(NamedTuple):
    """Gray in [0, 1], surface in m (0 where the map is thin), and weights of gray and depth or None, each [H, W]."""

    gray: Plane
    depth: Plane
    weights: tuple[Plane | None, Plane | None]


# ---- alignment ----


class AlignRules(NamedTuple):
    """When alignment stops, and which directions it does not change (native/align_level.h, `AlignLoop`).

    Maximum number of steps per level; the update (m and rad) and the change of cost that end a level; the share of the
    largest information below which a direction is undetermined; the minimum number of pixels.
    """

    iterations: int
    update_stop: float
    plateau_stop: float
    degenerate_share: float
    min_pixels: float


class AlignedPose(NamedTuple):
    """The result of an alignment: T_live_reference [4, 4]; sums [5] of the final iterate; steps on all levels; number
    of undetermined directions; mean depth of the reference in metres, and how many of its pixels have depth; gain: as
    of `align.Pair`, 1 without a step."""

    T: Matrix
    sums: Matrix
    steps: int
    degenerate: int
    depth_m: float
    readings: float
    gain: float


class LevelPlanes(NamedTuple):
    """One level of two images to align, and the weights of its residuals, in the layout of the kernels' `Level`; noise:
    σ of each reference reading relative to the z² law, None: all follow it; color_depth: as of `Pyramid`, of the
    reference; readouts: numbers of both images (`data.readout`), none if both were read at once."""

    reference_gray: Plane
    reference_depth: Plane
    weight_gray: Plane | None
    weight_depth: Plane | None
    live_gray: Plane
    live_depth: Plane
    intrinsics: Sequence[float]
    options: Sequence[float]
    noise: Plane | None = None
    color_depth: Plane | None = None
    readouts: Sequence[float] = ()


DEPTH_STEP_M = 0.05
"""Readings of a cell that differ by this much are not averaged, in a room."""
NORMAL_TERMS = 55
"""Number of values in one linearisation: H 21, b 6, counts 5, S 21, grays 2 (native/align_pixel.h)."""


@dataclass(frozen=True)
class ImageKernels:
    """Functions that halve and align images in host memory or on a device."""

    contiguous: Callable[[Plane], Plane]
    """Return a contiguous copy of a plane, or the plane itself if it is contiguous."""
    to_host: Callable[[Plane], NDArray[np.float32]]
    """Return a plane as an array in host memory."""
    beside: Callable[[NDArray[np.float32], Plane], Plane]
    """Return an array of host memory as a plane in the memory of another plane."""
    as_tensor: Callable[[Plane], Tensor]
    """Return a plane as a tensor that a view accepts as reference depth."""
    halve: Callable[
        [tuple[Plane | None, Plane | None], Plane | None, float], tuple[Plane | None, Plane | None, Plane | None]
    ]
    """Halve up to three planes of equal size: two are averaged over 2×2 cells; depth over the readings of a cell, if
    there are two or more and they differ by less than a step, the last argument, m. None stays None. With odd sizes the
    last row or column is dropped."""
    readings_of: Callable[[Plane, Plane], Any]
    """Return the mean depth of the coarsest level in metres (1 without readings), and how many pixels of the finest
    level have a reading, float64 [2]."""
    align: Callable[[Sequence[LevelPlanes], Any, Matrix, AlignRules], AlignedPose]
    """Align levels, finest first, starting at T_live_reference [4, 4]; `readings` is the result of `readings_of`."""
    normal_equations: Callable[[LevelPlanes, Sequence[Matrix], int], Matrix]
    """Linearise at up to 13 motions T_live_reference, from the number given on by fewer rows of the image
    (native/align_pixel.h); returns rows [n, `NORMAL_TERMS`]."""


# ---- the record ----


@dataclass(frozen=True)
class DeviceFits:
    """What a backend offers to `fit` and `slam`. The instance of plain torch (fit/backends.py) works for every view.
    The other instances replace the parts that their device computes itself, and take views of their own backend."""

    mapping_step: Callable[[Any], MappingStep]
    """Make the mapping step of a view; it computes `fit.losses.FUSED_TERMS`."""
    view_dependent_step: Callable[[Any, int], MappingStep]
    """Make the step of view-dependent colour up to a degree, from the mapping step."""
    settle: Callable[[Rows, Rates], None]
    """Apply Adam's missed motion to every row of a field when a fit ends."""
    to_host: Callable[[Sequence[Twist], Sequence[float | Tensor]], tuple[list[Matrix], list[float]]]
    """Return twists and costs in host memory; waits for the device once."""
    tracking_loss: Callable[[Any, Target, TrackingConfig, Tensor], tuple[float, Tensor]]
    """Write the gradient of the tracking loss to a view's planes (`fit.tracking_loss.tracking_gradient`)."""
    descend: Callable[[Tensor, Any, Target, Matrix, TrackingConfig, int], Descent]
    """Minimise the tracking loss (`fit.descent.descend`)."""
    reference_maps: Callable[[Any, TrackingConfig, Tensor | None], ReferenceMaps]
    """Make the reference maps of alignment from a view (`fit.tracking_loss.reference_maps`)."""
    live_planes: Callable[[View, Plane, Plane, Target], tuple[Plane, Plane]]
    """Return gray and depth of a frame (colour [H, W, 3], depth [H, W] m, its target) on the device that aligns
    them."""
    images: ImageKernels
