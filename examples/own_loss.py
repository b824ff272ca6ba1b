"""Fit a map to one image with your own loss term: `render` is differentiable, a term is one function.

python examples/own_loss.py [STEPS]
"""

import sys

import torch
from torch import Tensor

from sigmasplat import GaussianField, open_source
from sigmasplat.fit.losses import mean_over, term, total
from sigmasplat.render import render


@term
def charbonnier(color: Tensor, color_target: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of √(r² + 10⁻⁶) of the colour residual over valid pixels: a smooth L1."""
    return mean_over(((color - color_target) ** 2 + 1e-6).sqrt(), valid)


WEIGHTS = {"charbonnier": 1.0, "depth": 1.0, "nll_color": 1e-4}


def main(steps: str = "30") -> list[float]:
    """Put a gray splat on every fourth pixel, then fit all parameters; return the losses."""
    frame = open_source("synthetic:frames=120,width=80,height=60").frame(0)
    camera, depth_m = frame.camera, torch.tensor(frame.depth_m)
    points = torch.from_numpy(camera.rays())[::2, ::2] * depth_m[::2, ::2, None]
    means = points[depth_m[::2, ::2] > 0]
    field = GaussianField.from_values(means, means[:, 2] * 1.5 / camera.fx, torch.full_like(means, 0.5))
    field.params.requires_grad_()
    optimiser = torch.optim.Adam([field.params], lr=0.02)
    found = []
    for _ in range(int(steps)):
        view = render(field, camera, torch.eye(4))
        maps = {
            "color": view.color,
            "color_target": torch.tensor(frame.color),
            "depth": view.depth,
            "depth_target": depth_m,
            "variance": view.variance,
            "valid": depth_m > 0,
        }
        loss = total(WEIGHTS, maps)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        found.append(float(loss.detach()))
    print(f"loss {found[0]:.3f} → {found[-1]:.3f} in {len(found)} steps, {len(field)} splats")
    return found


if __name__ == "__main__":
    main(*sys.argv[1:])
