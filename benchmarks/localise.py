"""Find a camera in a map by plain descent through `render`, with some paths of the pose's gradient or with all."""

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.render import Render, render
from sigmasplat.render.pose_gradient import twist_matrix

Matrix = NDArray[np.float64]
WAYS = {
    "mean + depth": RenderConfig(covariance_pose_gradient=False, color_pose_gradient=False),
    "+ covariance": RenderConfig(color_pose_gradient=False),
    "+ harmonics": RenderConfig(),
}
"""Each has all paths of those before it."""
PATHS = ("mean", "depth", "covariance", "color")
COVERED_ALPHA = 0.95


@dataclass(frozen=True)
class Search:
    """How far off a camera begins, how many steps it has to find its place, and colour's share of the loss."""

    off_m: float
    off_deg: float
    steps: int
    weight_color: float


def disturbed(T_camera_world: Matrix, search: Search, random: np.random.Generator) -> Matrix:
    """Return a pose moved and turned by what `search` says, in a direction and about an axis that are drawn evenly."""
    drawn = random.normal(size=(2, 3))
    drawn *= np.array([[search.off_m], [np.radians(search.off_deg)]]) / np.linalg.norm(drawn, axis=1, keepdims=True)
    T = T_camera_world.copy()
    T[:3, 3] += drawn[0]
    T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), drawn[1]]))[:3, :3] @ T[:3, :3]
    return T


def localise(
    field: GaussianField, frame: Frame, T_camera_world: Matrix, switches: RenderConfig, search: Search
) -> tuple[Matrix, float]:
    """Descend by Adam on a twist about the middle of what is seen; return the last pose and the ms per step.

    About the camera a turn and a shift look alike, and descent creeps along the valley between them. Rates fall evenly
    to 0; all steps together reach four times as far as the start is off.
    """
    adam, n, middle = VectorAdam.of(6), search.steps, middle_of(frame)
    rates = np.repeat([search.off_m, np.radians(search.off_deg)], 3) * 8.0 / n
    clock = time.perf_counter()
    for step in range(n):
        twist = gradient(field, frame, T_camera_world, switches, search)
        motion = se3.exp(adam.step(twist, rates * (1.0 - step / n)))
        T_camera_world = middle @ motion @ se3.inverse(middle) @ T_camera_world
    return se3.orthonormalise(T_camera_world), 1e3 * (time.perf_counter() - clock) / n


def middle_of(frame: Frame) -> Matrix:
    """Return T_camera_middle: on the optical axis, as far as the median reading."""
    middle = np.eye(4)
    middle[2, 3] = np.median(frame.depth_m[frame.depth_m > 0])
    return middle


def gradient(
    field: GaussianField, frame: Frame, T_camera_world: Matrix, switches: RenderConfig, search: Search
) -> Matrix:
    """Return the gradient [6] of the loss by the left twist of T_middle_world."""
    twist, middle = torch.zeros(6, dtype=torch.float64, requires_grad=True), middle_of(frame)
    T_middle_world = torch.as_tensor(se3.inverse(middle) @ T_camera_world)
    T = torch.as_tensor(middle) @ torch.linalg.matrix_exp(twist_matrix(twist)) @ T_middle_world
    seen = render(field, frame.camera, T, options=switches)
    loss = pose_loss(seen, torch.tensor(frame.color), torch.tensor(frame.depth_m), search.weight_color)
    return np.asarray(torch.autograd.grad(loss, twist)[0].numpy())


def shares(field: GaussianField, frame: Frame, T_camera_world: Matrix, search: Search) -> dict[str, list[float]]:
    """Return how large each path's gradient is beside that of all, by ρ and by φ: |∂L| of the path over |∂L|."""
    whole = gradient(field, frame, T_camera_world, RenderConfig(), search)
    found = {}
    for path in PATHS:
        alone = RenderConfig(**{f"{other}_pose_gradient": other == path for other in PATHS})
        part = gradient(field, frame, T_camera_world, alone, search)
        found[path] = [float(np.linalg.norm(part[k]) / np.linalg.norm(whole[k])) for k in (slice(0, 3), slice(3, 6))]
    return found


def pose_loss(seen: Render, color: Tensor, depth_m: Tensor, weight_color: float) -> Tensor:
    """Average the absolute errors of colour and depth, where there is a reading and the map covers it."""
    valid = (depth_m > 0) & (seen.alpha.detach() > COVERED_ALPHA)
    on_color, on_depth = (seen.color - color).abs().mean(-1), (seen.depth - depth_m).abs()
    each = weight_color * on_color + (1.0 - weight_color) * on_depth
    return torch.where(valid, each, 0.0).sum() / valid.sum().clamp(min=1)


def view_dependence(field: GaussianField, frame: Frame, T_camera_world: Matrix) -> float:
    """Return how much the harmonics change what a camera sees: mean absolute difference of colour."""
    plain = GaussianField(field.params)
    with_them, without = (render(shown, frame.camera, T_camera_world).color for shown in (field, plain))
    return float((with_them - without).abs().mean())
