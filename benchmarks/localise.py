"""Find a camera pose in a map by gradient descent through `render`, without and with the gradient's covariance path."""

import time
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.render import Render, render
from sigmasplat.render.kernels import twist_matrix

Matrix = NDArray[np.float64]
WAYS = {
    name: RenderConfig(depth="center", covariance_pose_gradient=on)
    for name, on in (("without covariance", False), ("with covariance", True))
}
"""Both include the paths through means, depths and colours."""
COVERED_ALPHA = 0.95


@dataclass(frozen=True)
class Search:
    """Initial pose error, number of steps, and the share of colour in the loss."""

    off_m: float
    off_deg: float
    steps: int
    weight_color: float


def disturbed(T_camera_world: Matrix, search: Search, random: np.random.Generator) -> Matrix:
    """Return a pose moved and rotated as `search` says, in a random direction and about a random axis."""
    drawn = random.normal(size=(2, 3))
    drawn *= np.array([[search.off_m], [np.radians(search.off_deg)]]) / np.linalg.norm(drawn, axis=1, keepdims=True)
    T = T_camera_world.copy()
    T[:3, 3] += drawn[0]
    T[:3, :3] = se3.exp(np.concatenate([np.zeros(3), drawn[1]]))[:3, :3] @ T[:3, :3]
    return T


def localise(
    field: GaussianField, frame: Frame, T_camera_world: Matrix, switches: RenderConfig, search: Search
) -> tuple[Matrix, float]:
    """Descend by Adam on a twist about the centre of the view; return the last pose and the ms per step.

    About the camera centre, rotation and translation have similar effects, and descent would be slow. Learning rates
    fall linearly to 0; all steps together can reach four times the initial error.
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
    """Return T_camera_middle: a point on the optical axis at the median depth."""
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
    """Return the magnitude of the gradient with and without the covariance path relative to the whole gradient, for ρ
    and for φ: |∂L| of the part over |∂L|."""
    without, whole = (gradient(field, frame, T_camera_world, way, search) for way in WAYS.values())
    parts = {"covariance": whole - without, "all others": without}
    return {
        name: [float(np.linalg.norm(part[k]) / np.linalg.norm(whole[k])) for k in (slice(0, 3), slice(3, 6))]
        for name, part in parts.items()
    }


def pose_loss(seen: Render, color: Tensor, depth_m: Tensor, weight_color: float) -> Tensor:
    """Return the mean absolute error of colour and depth, where there is a reading and the map covers it."""
    valid = (depth_m > 0) & (seen.alpha.detach() > COVERED_ALPHA)
    on_color, on_depth = (seen.color - color).abs().mean(-1), (seen.depth - depth_m).abs()
    each = weight_color * on_color + (1.0 - weight_color) * on_depth
    return torch.where(valid, each, 0.0).sum() / valid.sum().clamp(min=1)


def view_dependence(field: GaussianField, frame: Frame, T_camera_world: Matrix) -> float:
    """Return how much the harmonics change the rendered image: mean absolute difference of colour."""
    plain = GaussianField(field.params)
    with_them, without = (render(shown, frame.camera, T_camera_world).color for shown in (field, plain))
    return float((with_them - without).abs().mean())
