"""A wavy wall of splats and a camera before it: the scene on which poses are fitted."""

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.target import Target
from sigmasplat.render.view import View

Array = NDArray[np.float64]
CAMERA = Camera(40, 30, 34.0, 35.0, 18.9, 15.2)
TRUTH = se3.exp(np.array([0.1, -0.05, 0.1, 0.05, 0.1, -0.08]))
"""T_camera_world."""


@cache
def wall(n: int = 400) -> Tensor:
    """Make a wavy, coloured wall about 2 m ahead, as rows [N, 17]; σ² differs from splat to splat."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.5, 1.5, n), rng.uniform(-1.15, 1.15, n)
    means = np.stack([x, y, 2.0 + 0.25 * np.sin(2.1 * x) + 0.2 * np.cos(3.0 * y)], 1)
    colors = 0.5 + 0.35 * np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * x + 4 * y)], 1)
    values = [torch.as_tensor(a, dtype=torch.float32) for a in (means, np.full(n, 0.12), colors)]
    log_variances = torch.as_tensor(rng.uniform(-9, -2, (n, 3)))
    return GaussianField.from_values(*values, opacities=0.98, log_variances=log_variances).params


def seen_from(view: View, T_camera_world: Array) -> Target:
    """Show the wall as a camera there would: what a fit has to find again, exact but for rounding."""
    view.forward(wall(), T_camera_world)
    h, w = CAMERA.height, CAMERA.width
    color = view.sums[:3, :h, :w].movedim(0, -1).numpy().copy()
    depth = torch.where(view.alpha[:h, :w] > 0.5, view.sums[3, :h, :w], 0.0).numpy().copy()
    return Target.of(Frame(0, 0.0, color, depth, CAMERA), (view.alpha.shape[0], view.alpha.shape[1]))


def lower_median(values: Tensor) -> Tensor:
    """Return the median, of an even count the lower middle one."""
    return values.sort().values[(len(values) - 1) // 2]


def assert_near(found: Array, true: Array, metres: float, degrees: float) -> None:
    """Hold a pose to the true one."""
    off = se3.inverse(true) @ found
    assert np.linalg.norm(off[:3, 3]) < metres, f"{1e3 * np.linalg.norm(off[:3, 3]):.2f} mm"
    assert np.rad2deg(se3.rotation_angle(off[:3, :3])) < degrees, f"{np.rad2deg(se3.rotation_angle(off[:3, :3])):.3f}°"
