"""What tests of the fits share: targets, planes as a render leaves them, fields in the middle of a run, and a watch on
what makes the host wait."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.target import Target
from splat_fields import crowd, params_of

WEIGHTS = {
    "l1": 0.8, "ssim": 0.2, "depth": 1.0, "nll_color": 1e-2, "nll_depth": 2e-2, "median_depth": 0.3, "moment": 0.2,
    "mean_depth": 0.4, "isotropy": 1.0, "isotropy_ratio": 0.1,
}  # fmt: skip
TERMS = ("l1", "ssim", "depth", "nll_color", "nll_depth", "median_depth", "moment", "mean_depth")


def target_of(camera: Camera, size: tuple[int, int], valid_share: float = 0.8) -> Target:
    """Draw a frame, with holes in its depth, on planes of `size`."""
    rng = np.random.default_rng(1)
    shape = (camera.height, camera.width)
    depth = rng.uniform(0.5, 4.0, shape) * (rng.random(shape) < valid_share)
    color = rng.uniform(0, 1, (*shape, 3)).astype(np.float32)
    return Target.of(Frame(0, 0.0, color, depth.astype(np.float32), camera), size)


def draw_planes(view: Any, target: Target) -> None:
    """Fill a view's planes as a render might: near the target, V from 1e-3 up, one in ten below 0 by rounding."""
    rng = np.random.default_rng(2)
    color = (target.color.double() + 0.2 * torch.as_tensor(rng.normal(size=target.color.shape))).clamp(0, 1)
    view.sums[:3] = color
    view.sums[3] = target.depth + 0.1 * torch.as_tensor(rng.normal(size=target.depth.shape))
    view.layers.median_depth[:] = target.depth + 0.1 * torch.as_tensor(rng.normal(size=target.depth.shape))
    view.layers.median_depth[torch.as_tensor(rng.random(target.depth.shape) < 0.2)] = 0.0
    view.alpha[:] = torch.as_tensor(rng.uniform(0.2, 1.0, target.depth.shape))
    view.moment[:] = torch.as_tensor(rng.uniform(0.0, 0.1, target.depth.shape))
    if len(view.sums) == 7:
        variance = torch.as_tensor(rng.uniform(1e-3, 0.2, color.shape))
        variance[torch.as_tensor(rng.random(color.shape) < 0.1)] = -1e-4
        view.sums[4:] = variance + color**2


def fields(n: int) -> tuple[GaussianField, GaussianField]:
    """Make a field and its double, mid-run: moments in motion, rows last moved up to 60 steps ago."""
    rng = np.random.default_rng(n)
    params = params_of(crowd())[:n].contiguous()
    last = torch.as_tensor(rng.choice([99, 99, 99, 80, 40], n), dtype=torch.int32)
    moments = torch.as_tensor(rng.normal(size=(n, 17)) * 1e-3), torch.as_tensor(rng.uniform(1e-9, 1e-5, (n, 17)))
    exact = GaussianField(params.double(), *(m.double() for m in moments), last.clone(), 99)
    return GaussianField(params, *(m.float().contiguous() for m in moments), last, 99), exact


def random_gradient(view: Any, step: int) -> None:
    """Draw image gradients, the same for both views."""
    h, w = view.camera.height, view.camera.width
    drawn = np.random.default_rng(step).normal(size=(len(view.sums), h, w))
    view.g_sums.zero_()
    view.g_sums[:, :h, :w] = torch.as_tensor(drawn).float()


RATES = Rates(torch.linspace(1e-4, 5e-3, 17) * (torch.arange(17) != 5), beta2=0.99)


WAITS = {
    Tensor.item, Tensor.tolist, Tensor.numpy, Tensor.cpu, Tensor.nonzero, Tensor.__float__, Tensor.__int__,
    Tensor.__bool__, Tensor.__array__,
}  # fmt: skip
"""What makes the host wait for a tensor of a device."""


class Watch(TorchFunctionMode):
    """Counts how often the host reads a tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.reads = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.reads += function in WAITS
        return function(*args, **(kwargs or {}))
