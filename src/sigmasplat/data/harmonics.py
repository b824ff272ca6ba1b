"""View-dependent colour: real spherical harmonics of degrees 1 to 3.

Order and signs are those of 3DGS's files: m = −l … l within each degree, odd m negative (Condon–Shortley), in the axes
of the field. Degree 0 is the field's own `colors`.
"""

from math import pi, sqrt

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from sigmasplat.errors import ConfigError

DEGREES = 3
FUNCTIONS = 15
"""Harmonics of degrees 1 to 3: 3 + 5 + 7."""


def count(degree: int) -> int:
    """Return the number of harmonics of degrees 1 to `degree`. Raises ConfigError unless 0 ≤ degree ≤ 3."""
    if not 0 <= degree <= DEGREES:
        raise ConfigError(f"view-dependent colour has degrees 0 to {DEGREES}, found {degree}")
    return (degree + 1) ** 2 - 1


def basis(directions: Tensor, degree: int = DEGREES) -> Tensor:
    """Evaluate the harmonics of degrees 1 to `degree` in unit directions [N, 3]: [N, 3, 8 or 15], ∫ Yᵢ Yⱼ dΩ = δᵢⱼ."""
    x, y, z = directions.unbind(-1)
    a = sqrt(3 / (4 * pi))
    values = [-a * y, a * z, -a * x]
    if degree > 1:
        a, b = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
        xx, yy, zz = x * x, y * y, z * z
        values += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, 0.5 * a * (xx - yy)]
    if degree > 2:
        a, b, c, d = (sqrt(n / (32 * pi)) for n in (35, 210, 21, 14))
        values += [
            -a * y * (3 * xx - yy),
            2 * b * x * y * z,
            -c * y * (4 * zz - xx - yy),
            d * z * (2 * zz - 3 * xx - 3 * yy),
            -c * x * (4 * zz - xx - yy),
            b * z * (xx - yy),
            -a * x * (xx - 3 * yy),
        ]
    return torch.stack(values[: count(degree)], -1)


def view_colors(
    colors: Tensor, harmonics: Tensor, means: Tensor, camera_position: Tensor, degree: int = DEGREES
) -> Tensor:
    """Return the colours [N, 3] of splats as a camera sees them: `colors` + Σ Y(direction from camera to splat) · k.

    harmonics [N, 45], columns: `data.field.ATTRIBUTES`; means [N, 3] and camera_position [3] in the same frame,
    metres. Not clamped: a colour may be outside [0, 1].
    """
    n = count(degree)
    if n == 0:
        return colors
    values = basis(normalize(means - camera_position, dim=1), degree)
    return colors + (values[:, None] @ harmonics[:, : 3 * n].reshape(-1, n, 3))[:, 0]


def turned(harmonics: Tensor, R_new_old: Tensor) -> Tensor:
    """Return harmonics [N, 45] for axes rotated by [3, 3]: Y(R d) · k_new = Y(d) · k_old.

    The rotation matrix of the harmonics is ∫ Y(R d) Y(d)ᵀ dΩ. Sums are written out because the rounding of a library's
    matrix product depends on memory alignment.
    """
    directions, weights = sphere_rule()
    new = basis((directions[:, None, :] * R_new_old.cpu().double()).sum(-1))
    mix = ((weights[:, None] * new)[:, :, None] * basis(directions)[:, None, :]).sum(0).to(harmonics)
    old = harmonics.reshape(-1, FUNCTIONS, 3)
    parts = (mix[:, j, None] * old[:, j, None] for j in range(FUNCTIONS))
    return sum(parts, torch.zeros_like(old)).reshape(harmonics.shape)


def sphere_rule() -> tuple[Tensor, Tensor]:
    """Return directions [D, 3] and weights [D], float64, for which the weighted sum is the integral of polynomials up
    to degree 7."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    z, turn = np.repeat(nodes, 8), np.tile(np.arange(8) * pi / 4, 4)
    r = np.sqrt(1 - z**2)
    directions = np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
    return torch.from_numpy(directions), torch.from_numpy(np.repeat(weights * pi / 4, 8))
