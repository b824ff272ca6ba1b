"""The mapping step of view-dependent colour, fused in the compiled CPU kernels (native/view_colors.h)."""

from typing import TYPE_CHECKING

from torch import Tensor

from sigmasplat.data.field import GaussianField
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.cpu.mapping_step import step_rows
from sigmasplat.fit.interface import Accumulator, Weights, one_image_only
from sigmasplat.fit.target import Target
from sigmasplat.fit.view_dependent import ImageStep
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.native import _core


class CompiledViewDependentStep:
    """`ViewDependentStep` in the kernels: one pass computes the gradients of splats and harmonics and steps both.

    `base` computes the image terms on the same view.
    """

    def __init__(self, base: ImageStep, view: CpuView, degree: int) -> None:
        self.base, self.view, self.degree = base, view, degree

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes, with the colours seen from that pose."""
        reference = target.depth_image if weights.get("moment") else None
        harmonics, layers = self._harmonics(field, 0.0), bool(weights.get("median_depth"))
        self.view.forward(field.params, T_camera_world, reference, layers=layers, harmonics=harmonics)

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss."""
        return self.base.images(target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Matrix, float]:
        """Step the splats in view and their harmonics, as `ViewDependentStep.splats`."""
        field.get_or_create("harmonics").steps += 1
        harmonics = self._harmonics(field, float(rates.of_attribute("harmonics").per_column[0]))
        return step_rows(self.view, field, rates, weights, frozen_colors, grad2d, harmonics)

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Raise ConfigError: this step takes one image only."""
        raise one_image_only()

    def _harmonics(self, field: GaussianField, rate: float) -> "_core.Harmonics":
        from sigmasplat.native import _core

        h = field.get_or_create("harmonics")
        return _core.Harmonics(h.params, h.moment1, h.moment2, h.last_step, self.degree, h.steps, rate, True)
