"""Render one camera repeatedly without allocating: raw parameter rows to image planes, and gradients back.

The loops of `fit` use this. Planes are padded to whole tiles: [rows, columns] ≥ [H, W]. Values outside the image are
defined but have no meaning, and a loss masks them (targets have depth 0 there).
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.config.input import SensorModel
from sigmasplat.data.camera import Camera
from sigmasplat.types import Matrix


class Layers(NamedTuple):
    """The splats that determine a pixel, planes [rows, columns]: int32 rows of the splat at median depth (CG-SLAM eq.
    8) and of the splat of largest weight, −1 = none; their weights; median_depth in m, 0 = none."""

    median_id: Tensor
    median_weight: Tensor
    dominant_id: Tensor
    dominant_weight: Tensor
    median_depth: Tensor

    @staticmethod
    def of(rows: int, columns: int, device: torch.device | None = None) -> "Layers":
        """Make empty planes, by default in host memory."""
        ids = [torch.zeros(rows, columns, dtype=torch.int32, device=device) for _ in range(2)]
        floats = [torch.zeros(rows, columns, device=device) for _ in range(3)]
        return Layers(ids[0], floats[0], ids[1], floats[1], floats[2])


MaybeLayers = tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]
NO_LAYERS: MaybeLayers = (None, None, None, None, None)


class View(Protocol):
    """One camera with its planes: sums [K, rows, columns] of (r, g, b, z[, σ²+c² ×3]), alpha, and their gradients."""

    backend: str
    """Name of the renderer: "cpu", "cuda" or "reference"."""
    camera: Camera
    options: RenderConfig
    sensor: SensorModel | None
    """Noise of the readings that are aligned; None: all follow the law of `options.depth_noise_per_m`."""
    sums: Tensor
    alpha: Tensor
    g_sums: Tensor
    g_alpha: Tensor
    moment: Tensor
    """U about the reference depth of the last forward pass with a reference, [rows, columns] m² (CG-SLAM eq. 10)."""
    layers: "Layers"
    g_moment: Tensor
    g_median_depth: Tensor
    """Gradients of `moment` and of the layers' median depth: used if the last forward pass rendered those."""

    @property
    def seconds(self) -> Matrix:
        """Return the seconds spent so far in project, sort, blend, blend backward, project backward."""

    def forward(
        self, params: Tensor, T_camera_world: Matrix, depth_reference: Tensor | None = None, layers: bool = False
    ) -> None:
        """Render parameter rows [N, 17] at a pose into `sums` and `alpha`. With a depth reference [H, W] m, also render
        `moment`; with layers=True, also `layers`."""

    def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
        """Propagate the gradient planes to parameter rows, written to g_params [N, 17]. Return the pose twist [6] (ρ,
        φ; m, rad). grad2d [N], if given, receives the norm of the gradient with respect to each image mean, per half
        image size (3DGS)."""

    def backward_pose(self, params: Tensor) -> Matrix:
        """Propagate the gradient planes of colour and depth to the pose only; return the twist (ρ, φ) [6]."""

    def visible(self, n: int) -> Tensor:
        """Return which of the n splats of the last forward pass reach the image, bool [n]."""
