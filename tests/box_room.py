"""A room whose view is known exactly: a box to stand in, a pillar and a low box in it, seen without any splat."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory

CAMERA = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
LOW, HIGH = np.array([-1.987, -1.513, 0.0]), np.array([2.013, 1.487, 2.5])
"""Corners of the room, m, z up; its walls lie on no cell's edge."""
PILLAR = (np.array([0.913, 0.513, 0.0]), np.array([1.313, 0.913, 2.5]))
CHEST = (np.array([-1.987, -0.3, 0.0]), np.array([-1.5, 0.4, 0.6]))
Box = tuple[np.ndarray, np.ndarray]
RememberedDepth = Callable[..., Any]


def pose(position: tuple[float, float, float], yaw: float, pitch: float) -> np.ndarray:
    """Return T_room_camera, looking along yaw (from +x) and pitch (down negative)."""
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, position
    return T


def walk(T_world_room: np.ndarray, images: int = 24, pitch: float = -0.5) -> Trajectory:
    """Turn round in the middle of the room, looking outwards and down, the first one along +y."""
    yaws = np.pi / 2 + 2 * np.pi * np.arange(images) / images
    poses = [pose((0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 1.5), yaw, pitch) for yaw in yaws]
    return Trajectory(np.arange(images) / 10.0, T_world_room @ np.stack(poses))


def cast(origin: np.ndarray, rays: np.ndarray, boxes: list[Box]) -> np.ndarray:
    """Return how many times each ray [..., 3] fits before a surface: of a box, or of the room from within."""
    with np.errstate(divide="ignore"):
        first = np.where(rays > 0, HIGH - origin, LOW - origin) / rays
        reach = first.min(-1)
        for low, high in boxes:
            a, b = (low - origin) / rays, (high - origin) / rays
            near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
            reach = np.where((near < far) & (near > 0) & (near < reach), near, reach)
    return np.asarray(reach)


def seer(
    T_world_room: np.ndarray,
    boxes: tuple[Box, ...] = (PILLAR, CHEST),
    alpha: Callable[[np.ndarray], np.ndarray] = lambda at: np.ones(at.shape[:-1]),
    sigma_m: Callable[[np.ndarray], np.ndarray] = lambda at: np.full(at.shape[:-1], 0.01),
) -> RememberedDepth:
    """Return a renderer of the room; alpha and how far splats disagree are functions of the place in it [..., 3]."""

    def show(field: GaussianField, camera: Camera, T_camera_world: Any, depth_reference: Any = None) -> Any:
        T = se3.inverse(T_world_room) @ se3.inverse(np.asarray(T_camera_world, float))
        rays = camera.rays().astype(float) @ T[:3, :3].T
        depth = cast(T[:3, 3], rays, list(boxes))
        at = T[:3, 3] + rays * depth[..., None]
        a = alpha(at)
        maps = {
            "depth": depth * a,
            "alpha": a,
            "color": np.repeat((0.5 * a)[..., None], 3, -1),
            "variance": np.repeat((0.04 * a)[..., None], 3, -1),
            "uncertainty": a * sigma_m(at) ** 2,
        }
        return SimpleNamespace(**{name: torch.tensor(values, dtype=torch.float32) for name, values in maps.items()})

    return show


def splats(T_world_room: np.ndarray, sigma: Callable[[np.ndarray], np.ndarray] | None = None) -> GaussianField:
    """Return flat splats on the floor, 5 cm apart, of a deviation that is a function of the place [N, 3]."""
    x, y = np.meshgrid(np.arange(LOW[0], HIGH[0], 0.05), np.arange(LOW[1], HIGH[1], 0.05))
    at = np.stack([x.ravel() + 0.02, y.ravel() + 0.02, np.zeros(x.size)], 1)
    deviation = np.full(len(at), 0.01) if sigma is None else sigma(at)
    field = GaussianField.from_values(
        torch.tensor(at, dtype=torch.float32),
        torch.tensor([[0.03, 0.03, 0.002]]).repeat(len(at), 1),
        torch.full((len(at), 3), 0.5),
        opacities=0.95,
        log_variances=torch.tensor(2.0 * np.log(deviation), dtype=torch.float32)[:, None],
    )
    return field.moved(torch.from_numpy(T_world_room))
