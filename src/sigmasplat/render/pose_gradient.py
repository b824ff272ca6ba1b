"""Turn the gradient on a pose's tangent space into one autograd can carry."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def pose_gradient(T_camera_world: Tensor, twist: NDArray[np.float64]) -> Tensor:
    """Express a left-twist gradient (ρ, φ) as a [4, 4] matrix gradient with the same value along every rigid motion.

    <G, [φ]× R | φ×t + ρ> = ρ·g_ρ + φ·g_φ for G = (½ [g_φ − t × g_ρ]× R | g_ρ).
    """
    T = T_camera_world.detach().double().numpy()
    g_rho, g_phi = twist[:3], twist[3:]
    a = 0.5 * (g_phi - np.cross(T[:3, 3], g_rho))
    G = np.zeros((4, 4))
    G[:3, :3] = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]]) @ T[:3, :3]
    G[:3, 3] = g_rho
    return torch.as_tensor(G, dtype=T_camera_world.dtype)
