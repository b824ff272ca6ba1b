"""The mapping step of view-dependent colour (fit/view_dependent.py) on a CUDA device (native/cuda/harmonics.cuh)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import Accumulator, GaussianField, Matrix, Rates, Target, Weights, count, one_image_only, render_for
from sigmasplat.plugins.cuda.launch import blocks_for
from sigmasplat.plugins.cuda.mapping_step import CudaStep
from sigmasplat.plugins.cuda.rows import add_shape_gradient, step_rows


class CudaViewDependentStep:
    """`ViewDependentStep` on a device. The host does not wait until `to_host`."""

    def __init__(self, base: CudaStep, degree: int) -> None:
        self.base, self.view, self.degree = base, base.view, degree
        self.width = 3 * count(degree)
        self.rows, self._eye = torch.empty(0), np.zeros(15, np.float32)

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        """Render the field into the view's planes, with the colours seen from that pose."""
        harmonics, n = field.get_or_create("harmonics").params, len(field)
        self.rows, self._eye = field.params.clone(), _eye(T_camera_world)
        with self.view.stages.of("project"):
            self.view.raster.launch_fit(
                "show_colors", blocks_for(n), self.rows, harmonics, n, self.degree, harmonics.shape[1], self._eye
            )
        render_for(self.view, self.rows, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> Tensor:
        """Write the gradient of every image term to the view's gradient planes; return the loss, on the device."""
        return self.base.images(target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Step as `ViewDependentStep.splats` does; twist and cost stay on the device."""
        view, gradient, harmonics = self.view, torch.empty_like(field.params), field.get_or_create("harmonics")
        twist, visible = view.backward_on_device(self.rows, gradient, grad2d), view.raster.visible
        cost = add_shape_gradient(view, visible, field, gradient, weights, frozen_colors)
        on_harmonics, on_camera = self._through_colors(field, visible, gradient)
        twist[:3] += on_camera
        step_rows(view, visible, field, gradient, rates)
        harmonics.steps += 1
        of_harmonics = Rates(rates.of_attribute("harmonics").per_column[: self.width], rates.beta2)
        step_rows(view, visible, harmonics, on_harmonics, of_harmonics)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Raise ConfigError: this step takes one image only."""
        raise one_image_only()

    def _through_colors(self, field: GaussianField, visible: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Propagate the gradient of the colours, in rows [N, 17], to the harmonics and through the viewing direction.

        Returns the gradient of the harmonics [N, width] and of the camera's translation [3]. The gradient of the means
        is added to the same rows.
        """
        raster, n, harmonics = self.view.raster, len(field), field.get_or_create("harmonics").params
        found, partial = raster.empty(n, self.width), raster.empty(blocks_for(n), 3, dtype=torch.float64)
        with self.view.stages.of("project_backward"):
            raster.launch_fit(
                "carry_colors", blocks_for(n), field.params, harmonics, visible, n, self.degree, harmonics.shape[1],
                self.width, self._eye, gradient, found, partial,
            )  # fmt: skip
        return found, partial.sum(0)


def _eye(T_camera_world: Matrix) -> NDArray[np.float32]:
    """Return the kernels' `Eye` [15]: the camera's position, and R and t of its pose."""
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    return np.concatenate([-R.T @ t, R.ravel(), t]).astype(np.float32)
