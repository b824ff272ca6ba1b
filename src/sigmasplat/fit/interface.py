"""What the fits ask of a device: one record, `DeviceFits`, with a row for each backend in fit/backends.py."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.errors import ConfigError
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.model.field import GaussianField, Rows
from sigmasplat.render.view import CorrelationView, View
from sigmasplat.types import Matrix

Weights = Mapping[str, float]
"""Loss terms (`fit.losses`) by name, and how much each counts."""
Twist = Matrix | Tensor
"""Gradient by a pose's left twist (ρ, φ) [6]; a tensor may still be computed on a device, as may a cost."""
Plane = Any
"""An image [H, W], float32: an array in the host's memory, or a tensor on the device that aligns it."""


# ---- mapping ----


class Accumulator(Protocol):
    """Adds up the gradient of several images' mean loss, then steps every splat that any of them shows."""

    def add(self, field: GaussianField, share: float, grad2d: Tensor | None = None) -> Twist:
        """Add the view's gradient planes at their share of the mean; return the image's own pose twist [6]."""
        ...

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float | Tensor:
        """Add the gradient of the shape terms, take Adam's step; return the cost of those terms."""
        ...


class FitStats(Protocol):
    """Statistics of a fit, such as `DensifyStats`."""

    def on_gradient(self, keyframe: Keyframe, grad2d: Tensor) -> None:
        """Receive the norm of each splat's gradient by its image mean [N], of one keyframe in one step. The tensor is
        reused by the next step."""


class MappingStep(Protocol):
    """One mapping step on a view: render, the gradient of the image terms, and from there to splats and Adam's step.

    Twists and costs may still be on a device; `DeviceFits.to_host` reads them.
    """

    @property
    def view(self) -> View:
        """Return the view it renders to."""

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field to the view's planes."""

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        ...

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Twist, float | Tensor]:
        """Step the splats in view; return the pose twist [6] and the cost of the shape terms.

        The first `frozen_colors` splats keep their colours. grad2d [N]: filled as by `View.backward`.
        """
        ...

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Make room for the gradient of several images. Raises ConfigError where a step takes one image only."""
        ...


def one_image_only() -> ConfigError:
    """Return what steps raise that cannot add up several images."""
    return ConfigError("mapping.frames_per_step must be 1 with full colour covariance or view-dependent colour")


# ---- tracking ----


class Descent(NamedTuple):
    """Result of a descent: T_camera_world [4, 4], exposure (a, b) of exp(a)·Ĉ + b, the first and the least loss, and
    how many steps were taken."""

    T_camera_world: Matrix
    exposure: tuple[float, float]
    first_loss: float
    loss: float
    steps: int


class ReferenceMaps(NamedTuple):
    """Gray in [0, 1], surface in m (0 where the map is thin), weights of gray and depth or None, each [H, W]."""

    gray: Plane
    depth: Plane
    weights: tuple[Plane | None, Plane | None]


# ---- alignment ----


class AlignRules(NamedTuple):
    """When alignment stops and which directions it leaves alone (native/align_level.h, `AlignLoop`): steps a level; the
    update, m and rad, and the change of cost that end one; the share of the best direction's information below which
    one is not decided; the least number of pixels."""

    iterations: int
    update_stop: float
    plateau_stop: float
    degenerate_share: float
    min_pixels: float


class AlignedPose(NamedTuple):
    """T_live_reference [4, 4]; sums [4] of the final iterate; steps of all levels; how many directions were left alone;
    mean depth of the reference, metres, and how many of its pixels have one."""

    T: Matrix
    sums: Matrix
    steps: int
    degenerate: int
    depth_m: float
    readings: float


class LevelPlanes(NamedTuple):
    """One level of two images to align, and how their residuals are weighed, as the kernels' `Level` takes it."""

    reference_gray: Plane
    reference_depth: Plane
    weight_gray: Plane | None
    weight_depth: Plane | None
    live_gray: Plane
    live_depth: Plane
    intrinsics: Sequence[float]
    options: Sequence[float]


NORMAL_TERMS = 52
"""Numbers of one linearisation: H 21, b 6, sums 4, S 21 (native/align_pixel.h)."""


@dataclass(frozen=True)
class ImageKernels:
    """What halves and aligns images where their planes are: in the host's memory or on a device."""

    contiguous: Callable[[Plane], Plane]
    """Return a plane whose rows follow each other without gaps."""
    as_tensor: Callable[[Plane], Tensor]
    """Return a plane as a tensor that a view takes as reference depth."""
    halve: Callable[[tuple[Plane | None, Plane | None], Plane | None], tuple[Plane | None, Plane | None, Plane | None]]
    """Halve up to three planes of one size: two averaged over 2×2 cells, and a depth where it is one surface.
    What is None stays None. Odd sizes drop their last row or column."""
    readings_of: Callable[[Plane, Plane], Any]
    """Return of a finest and a coarsest depth: the coarsest one's mean, metres (1 where nothing is read), and how many
    pixels of the finest have a reading, float64 [2]."""
    align: Callable[[Sequence[LevelPlanes], Any, Matrix, AlignRules], AlignedPose]
    """Align levels, finest first, by their readings, from a guess T_live_reference [4, 4]."""
    normal_equations: Callable[[LevelPlanes, Sequence[Matrix]], Matrix]
    """Linearise at some motions T_live_reference, at most 13: rows [n, `NORMAL_TERMS`]."""


# ---- the record ----


@dataclass(frozen=True)
class DeviceFits:
    """What a backend offers to `fit` and `slam`. The row of plain torch (fit/backends.py) works for every view; the
    other rows replace what their device does itself. Functions of a row take views of its own backend."""

    mapping_step: Callable[[Any], MappingStep]
    """Make the step of a view; it knows the terms that fit/fused_terms.py gives its backend."""
    covariance_step: Callable[[CorrelationView], MappingStep]
    """Make the step that also fits the full colour covariance."""
    view_dependent_step: Callable[[Any, int], MappingStep]
    """Make the step of view-dependent colour up to a degree from one of the two others."""
    settle: Callable[[Rows, Rates], None]
    """Bring every row of a field to the present step of Adam when a fit ends."""
    to_host: Callable[[Sequence[Twist], Sequence[float | Tensor]], tuple[list[Matrix], list[float]]]
    """Return twists and costs in the host's memory; it waits for the device once."""
    tracking_loss: Callable[[Any, Target, TrackingConfig, Tensor], tuple[float, Tensor]]
    """Write the gradient of the tracking loss to a view's planes (`fit.tracking_loss.tracking_gradient`)."""
    descend: Callable[[Tensor, Any, Target, Matrix, TrackingConfig, int], Descent]
    """Descend the tracking loss (`fit.descent.descend`)."""
    reference_maps: Callable[[Any, TrackingConfig, Tensor | None], ReferenceMaps]
    """Read a reference for alignment off a view (`fit.reference_maps.reference_maps`)."""
    live_planes: Callable[[View, Plane, Plane, Target], tuple[Plane, Plane]]
    """Return gray and depth of a frame (colour [H, W, 3], depth [H, W] m, its target) where they are aligned."""
    images: ImageKernels
    aligns: bool
    """Whether images may be aligned where the settings do not ask for it: plain torch runs without compiled kernels."""
