"""A map like a fitted one, for tests of what becomes of maps: splats on the synthetic room's surfaces."""

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.plugins.sources.synthetic import SyntheticRoom
from sigmasplat.render import render

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)


@cache
def poses() -> list[NDArray[np.float64]]:
    """T_world_camera of three views, the map's own two and one between."""
    return list(room().truth().T_world_camera[[0, 6, 3]])


@cache
def room() -> SyntheticRoom:
    return SyntheticRoom(frames=120, width=96, height=72)


def room_map(degree: int = 0) -> GaussianField:
    """Every pixel of two frames as a splat: uneven, turned at random, of various opacity, with σ² and harmonics."""
    random = torch.Generator().manual_seed(3)
    parts = []
    for frame, T in ((room().frame(0), poses()[0]), (room().frame(6), poses()[1])):
        seen = frame.depth_m > 0
        points = (room().camera.rays() * frame.depth_m[..., None])[seen] @ T[:3, :3].T + T[:3, 3]
        n = len(points)
        scales = torch.as_tensor(frame.depth_m[seen] / CAMERA.fx)[:, None].float()
        parts.append(
            GaussianField.from_values(
                torch.as_tensor(points, dtype=torch.float32),
                scales * torch.exp(0.6 * torch.randn(n, 3, generator=random)),
                torch.as_tensor(frame.color[seen], dtype=torch.float32),
                quats=3.0 * torch.randn(n, 4, generator=random),
                opacities=torch.sigmoid(1.5 + 1.5 * torch.randn(n, generator=random)),
                log_variances=-6.0 + torch.randn(n, 3, generator=random),
            )
        )
    field, other = parts
    field.append(other)
    if degree:
        k = torch.zeros(len(field), 45)
        k[:, : 3 * count(degree)] = 0.1 * torch.randn(len(field), 3 * count(degree), generator=random)
        field.attributes["harmonics"] = Rows(k)
    return field


def psnr_db(a: GaussianField, b: GaussianField) -> float:
    """Peak signal to noise ratio between renders of two maps, over all views together; 1 is the peak."""
    squares = [(view(a, T) - view(b, T)).square().mean() for T in poses()]
    return float(-10.0 * torch.log10(torch.stack(squares).mean() + 1e-20))


def view(field: GaussianField, T_world_camera: NDArray[np.float64]) -> torch.Tensor:
    with torch.no_grad():
        return render(field, CAMERA, np.linalg.inv(T_world_camera)).color.clamp(0.0, 1.0)
