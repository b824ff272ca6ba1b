"""Write scenes as rows of a field, and run views forward and back as a fit does."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from paper_settings import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from splat_scenes import Scene, make

OPTIONS = RenderConfig()
CPU = torch.device("cpu")
BIG = Camera(101, 75, 90.0, 92.0, 52.3, 34.8)
"""Several tiles each way, a multiple of none; with `CROWD` splats several units of work, the last one ragged."""
CROWD = 2003


class Gradients:
    """Statistics of a fit that keep every gradient: (keyframe's index, norms [N]) in the order given."""

    def __init__(self) -> None:
        self.given: list[tuple[int, Tensor]] = []

    def on_gradient(self, keyframe: Keyframe, grad2d: Tensor) -> None:
        self.given.append((keyframe.index, grad2d.clone()))


def params_of(s: Scene) -> Tensor:
    """Write a scene as parameter rows [N, 17], float32, with variances from e⁻⁷ to e⁻¹."""
    log_variances = torch.as_tensor(np.random.default_rng(5).uniform(-7, -1, (len(s.means), 3)))
    field = GaussianField.from_values(
        s.means, s.scales, s.features[:, :3], quats=s.quats, opacities=s.opacities, log_variances=log_variances
    )
    return field.params.float()


def crowd(seed: int = 0, kind: str = "random", count: int = CROWD) -> Scene:
    """Make a scene large enough that threads share it."""
    return make(kind, count, BIG, seed)


def plane_gradients(camera: Camera, k: int, seed: int = 3) -> tuple[Tensor, Tensor]:
    """Draw ∂L/∂sums [K, H, W] and ∂L/∂alpha [H, W]."""
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    return torch.as_tensor(rng.normal(size=(k, *size))).float(), torch.as_tensor(rng.normal(size=size)).float()


def maps_of(view: Any) -> Tensor:
    """Return the image part of sums and alpha, [K + 1, H, W]."""
    h, w = view.camera.height, view.camera.width
    return torch.cat([view.sums, view.alpha[None]])[:, :h, :w].clone()


def there_and_back(view: Any, params: Tensor, T_camera_world: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Render and differentiate: maps [K + 1, H, W], gradient rows [N, 17], twist [6]."""
    h, w = view.camera.height, view.camera.width
    view.forward(params, np.asarray(T_camera_world, np.float64))
    g_sums, g_alpha = plane_gradients(view.camera, len(view.sums))
    view.g_sums.zero_()
    view.g_alpha.zero_()
    view.g_sums[:, :h, :w], view.g_alpha[:h, :w] = g_sums, g_alpha
    rows = torch.full_like(params, torch.nan)  # every row must be written, seen or not
    twist = view.backward(params, rows)
    return maps_of(view), rows, torch.as_tensor(twist.copy())


def view_on(kernels: str, camera: Camera, variance: bool = True) -> CpuView | CudaView:
    """Make a view on kernels under test: "cuda" (emulated on the CPU), else the CPU's."""
    if kernels == "cuda":
        return CudaView(camera, OPTIONS, variance, CPU)
    return CpuView(camera, OPTIONS, variance)


def exact_view(camera: Camera, variance: bool, options: RenderConfig = OPTIONS) -> ReferenceView:
    """Make a reference view that computes in float64 when given float64 rows."""
    view = ReferenceView(camera, options, variance)
    for name in ("sums", "alpha", "g_sums", "g_alpha", "moment", "g_moment", "g_median_depth"):
        setattr(view, name, getattr(view, name).double())
    view.layers = view.layers._replace(median_depth=torch.zeros_like(view.alpha))
    return view
