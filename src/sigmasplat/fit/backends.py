"""Choose what takes a mapping step: the fused kernels of a view's device where they know all terms, or torch."""

from typing import Protocol

from torch import Tensor

from sigmasplat.errors import ConfigError
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.color_covariance import FullCovarianceStep
from sigmasplat.fit.cpu.mapping_step import CompiledImages, CompiledStep
from sigmasplat.fit.cuda.mapping_step import CudaStep
from sigmasplat.fit.cuda.rows import CudaGathered
from sigmasplat.fit.cuda.view_dependent import CudaViewDependentStep
from sigmasplat.fit.mapping_step import COMPILED_TERMS, Gathered, TorchStep, Twist, Weights
from sigmasplat.fit.target import Target
from sigmasplat.fit.view_dependent import ViewDependentStep
from sigmasplat.model.field import GaussianField
from sigmasplat.render.backend import make_covariance_view
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.cuda.covariance_view import CudaCovarianceView
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.reference.covariance_view import CovarianceView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


class MappingStep(Protocol):
    """One mapping step on a view: render, the image terms' gradient, from there to the splats and Adam's step.

    Twists and costs may be on a device still; `step.arrived` brings them.
    """

    @property
    def view(self) -> View: ...

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field to the view's planes."""

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        ...

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, pull: Tensor | None = None
    ) -> tuple[Twist, float | Tensor]:
        """Step the splats in view; return the pose twist [6] and what the shape terms cost."""
        ...


class Gathering(Protocol):
    """The gradient of several images' mean loss, as `Gathered`."""

    def add(self, field: GaussianField, share: float, pull: Tensor | None = None) -> Twist: ...
    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float | Tensor: ...


def step_for(field: GaussianField, view: View, weights: Weights, degree: int) -> MappingStep:
    """Make the step that fits a field on a view; degree: of view-dependent colour.

    Raises ConfigError where full colour covariance meets terms that its view does not make maps for.
    """
    full = bool(weights["nll_color_full"])
    if full and (weights["alignment"] or weights["moment"]):
        raise ConfigError(
            "mapping.color_covariance full goes without weight_alignment and weight_moment; set both to 0"
        )
    seen = make_covariance_view(view, field.carry("correlations")) if full else view
    fused = {name for name, weight in weights.items() if weight} <= {*COMPILED_TERMS, "nll_color_full"}
    if fused and isinstance(seen, CudaView):
        there = CudaStep(seen)
        return CudaViewDependentStep(there, degree) if degree else there
    step = _on_host(seen, fused and isinstance(view, CpuView))
    return ViewDependentStep(step, degree) if degree else step


def _on_host(view: View, compiled: bool) -> TorchStep | CompiledStep | FullCovarianceStep:
    """Make the plain step of a view, in the CPU's kernels or in torch."""
    if isinstance(view, CovarianceView | CudaCovarianceView):
        return FullCovarianceStep(view, CompiledImages(view) if compiled else TorchStep(view))
    return CompiledStep(view) if compiled and isinstance(view, CpuView) else TorchStep(view)


def gathering(step: MappingStep, field: GaussianField) -> Gathering:
    """Make room for the gradient of several images. Raises ConfigError where a step takes one image only."""
    if not isinstance(step, TorchStep | CompiledStep | CudaStep) or isinstance(step.view, CudaCovarianceView):
        raise ConfigError("mapping.frames_per_step must be 1 with full colour covariance or view-dependent colour")
    return CudaGathered(step.view, field) if isinstance(step, CudaStep) else Gathered(step.view, field)
