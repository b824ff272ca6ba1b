"""Add a render channel: learn labels of splats from one image and render them from other views.

python examples/own_channel.py [STEPS]

The kernel blends the columns of `features`, whatever they mean. Here they are the probabilities of K labels. They are
learned from one labelled image while the map is fixed, and rendered from another pose. Labels can come from a
segmentation network, a thermal camera or a click.
"""

import sys

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat import Camera, GaussianField, open_source
from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.render import cpu

OPTIONS = RenderConfig(depth="center")


def blended(
    field: GaussianField, features: Tensor, camera: Camera, T_camera_world: NDArray[np.float64]
) -> tuple[Tensor, Tensor]:
    """Blend features [N, K] of splats into an image [H, W, K], with alpha [H, W]; differentiable in both arguments.

    The channels are Σ w·feature: divide by alpha for the mean.
    """
    seen = cpu.project(field.means, field.quats, field.scales, torch.from_numpy(T_camera_world), camera, OPTIONS)
    maps = cpu.blend(*seen, field.opacities, features, None, camera, OPTIONS)
    return maps.sums, maps.alpha


def seeded(frame: Frame) -> GaussianField:
    """Put a splat on every second pixel with a reading, in the camera coordinates of the frame."""
    points = (torch.from_numpy(frame.camera.rays()) * torch.tensor(frame.depth_m)[..., None])[::2, ::2]
    colors, near = torch.tensor(frame.color)[::2, ::2], points[..., 2] > 0
    widths_m = points[near][:, 2] * 1.2 / frame.camera.fx
    return GaussianField.from_values(points[near], widths_m, colors[near], opacities=0.95)


def label(color: NDArray[np.float32]) -> Tensor:
    """Return simple labels in place of a segmentation: 0 dark, 1 warm, 2 the rest, [H, W]."""
    r, _, b = np.moveaxis(color, -1, 0)
    return torch.from_numpy(np.where(color.max(-1) < 0.35, 0, np.where(r > b + 0.1, 1, 2)))


def learnt(field: GaussianField, labels: Tensor, frame: Frame, T: NDArray[np.float64], steps: int) -> Tensor:
    """Learn label probabilities [N, K] of splats from the labels [H, W] of one image, by cross-entropy."""
    logits = torch.zeros(len(field), int(labels.max()) + 1, requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.3)
    for _ in range(steps):
        sums, alpha = blended(field, logits.softmax(1), frame.camera, T)
        chosen = (sums / alpha.clamp(min=1e-6)[..., None]).gather(2, labels[..., None])[..., 0]
        loss = -chosen.clamp(min=1e-6).log()[alpha.detach() > 0.5].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return logits.detach().softmax(1)


def main(steps: str = "40") -> float:
    """Label one image of the built-in room, render the labels from another pose; return the share of correct pixels."""
    source = open_source("synthetic:frames=240,width=160,height=120")
    poses = source.truth().T_world_camera  # for brevity; the trajectory of a run works too
    here, there = source.frame(0), source.frame(8)
    field = seeded(here)
    probabilities = learnt(field, label(here.color), here, np.eye(4), int(steps))
    with torch.no_grad():
        sums, alpha = blended(field, probabilities, there.camera, se3.inverse(poses[8]) @ poses[0])
    covered = alpha > 0.9
    right = float((sums.argmax(2) == label(there.color))[covered].float().mean())
    print(f"{right:.0%} of the labels are correct where the map covers the other view: {covered.sum()} pixels")
    return right


if __name__ == "__main__":
    main(*sys.argv[1:])
