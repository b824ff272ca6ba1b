"""Test a backend before it is used: one image of a few hundred splats and its gradient, against the definition."""

from collections.abc import Callable
from dataclasses import dataclass
from timeit import repeat

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View

Maker = Callable[[Camera, RenderConfig, bool], View]
"""Makes a view of a camera, with or without variances."""
MAX_DIFFERENCE, MEAN_DIFFERENCE, GRADIENT = 1e-2, 1e-4, 1e-2
"""If rounding moves a splat across the threshold alpha_min, a pixel can change by up to 1/255, and with it the
gradient of this splat: the last value is a share of the norm of all gradients."""
SPLATS, ROUNDS = 20_000, 6


@dataclass(frozen=True)
class SelfTest:
    """Largest and mean difference of the images; that of the gradients, as a share of their norm."""

    largest: float
    mean: float
    gradient: float

    @property
    def ok(self) -> bool:
        """Return whether the backend agrees with the definition."""
        return self.largest < MAX_DIFFERENCE and self.mean < MEAN_DIFFERENCE and self.gradient < GRADIENT

    def __str__(self) -> str:
        return f"largest difference {self.largest:.1e}, mean {self.mean:.1e}, gradients {self.gradient:.1e}"


def self_test(make: Maker) -> SelfTest:
    """Test the views that a backend makes. Raises BackendError if it cannot render."""
    rows, camera = _cloud(300, 0.1), Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    (ours, slopes), (expected, true_slopes) = (_rendered(each, rows, camera) for each in (make, ReferenceView))
    off, gradient = (ours - expected).abs(), (slopes - true_slopes).norm() / true_slopes.norm()
    return SelfTest(*(float(torch.nan_to_num(each, nan=torch.inf)) for each in (off.max(), off.mean(), gradient)))


def kernel_speed(make: Maker) -> str:
    """Return in words how long an image with its gradient takes; the first one, which compiles kernels, apart."""
    rows, camera = _cloud(SPLATS, 0.02), Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    view = make(camera, RenderConfig(), True)
    first, *others = (1000.0 * each for each in repeat(lambda: _gradient(view, rows), number=1, repeat=ROUNDS + 1))
    work = f"an image of 320×240 from {SPLATS:,} splats with gradients"
    return f"{np.median(others):.1f} ms for {work} (the first {first:.0f} ms)"


def _rendered(make: Maker, rows: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return all planes [K + 1, H, W] of an image, and the gradient [N, 17] of a fixed sum of them."""
    view = make(camera, RenderConfig(), True)
    gradient = _gradient(view, rows)
    planes = torch.cat([view.sums, view.alpha[None]])[:, : camera.height, : camera.width]
    return planes.cpu(), gradient.cpu()


def _gradient(view: View, rows: Tensor) -> Tensor:
    params = rows.to(view.sums.device)
    view.forward(params, np.eye(4))
    view.g_sums.fill_(1.0)
    view.g_alpha.fill_(1.0)
    view.backward(params, gradient := torch.empty_like(params))
    return gradient


def _cloud(count: int, size_m: float) -> Tensor:
    """Return rows [N, 17] of a fixed random cloud of splats before a camera at the origin."""
    random = torch.Generator().manual_seed(0)
    means, quats, scales, opacity, colors = (torch.rand(count, n, generator=random) for n in (3, 4, 3, 1, 3))
    means = (means - 0.5) * torch.tensor([3.0, 2.0, 2.0]) + torch.tensor([0.0, 0.0, 2.0])
    log_scales = torch.log(0.1 * size_m + size_m * scales)
    return torch.cat([means, quats - 0.5, log_scales, 4.0 * opacity - 1.4, colors, torch.full_like(colors, -4.0)], 1)
