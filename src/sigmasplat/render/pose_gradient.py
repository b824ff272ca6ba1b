"""Convert the gradient on a pose's tangent space to a matrix gradient for autograd."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def pose_gradient(T_camera_world: Tensor, twist: NDArray[np.float64] | Tensor) -> Tensor:
    """Return a left-twist gradient (ρ, φ) as a [4, 4] matrix gradient with the same value along every rigid motion.

    <G, [φ]× R | φ×t + ρ> = ρ·g_ρ + φ·g_φ for G = (½ [g_φ − t × g_ρ]× R | g_ρ). It is on the device of T_camera_world.
    """
    T = T_camera_world.detach().double()
    g = torch.as_tensor(twist).to(T)
    g_rho, g_phi = g[:3], g[3:]
    a = 0.5 * (g_phi - torch.linalg.cross(T[:3, 3], g_rho))
    turned = torch.linalg.cross(a[:, None].expand(3, 3), T[:3, :3], dim=0)  # [a]× R
    bottom = torch.zeros_like(T[:1])
    return torch.cat([torch.cat([turned, g_rho[:, None]], 1), bottom]).to(T_camera_world.dtype)


def twist_matrix(xi: Tensor) -> Tensor:
    """Return a twist (ρ, φ) [6], m and rad, as the matrix [4, 4] whose exponential is the motion."""
    zero = torch.zeros((), dtype=xi.dtype)
    x, y, z, a, b, c = xi
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero, zero, zero, zero]]
    return torch.stack([torch.stack(row) for row in rows])
