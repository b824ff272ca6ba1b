"""Split and clone splats where the loss has the largest gradient, and find splats that have grown too large (3DGS;
CG-SLAM §5)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import DensifyConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.fit.densify_stats import DensifyStats

MEANS, SCALES = COLUMNS["means"], COLUMNS["log_scales"]
CHILD_SCALE = 1.6
"""Scale of each half of a split splat: the scale of the splat divided by this (3DGS)."""
RADIUS_SIGMAS = 3.0


def densify_mask(stats: DensifyStats, split_gradient: float, most: int | None = None) -> Tensor:
    """Return which splats to densify, bool [N]: those whose mean gradient over the steps that saw them is at least
    `split_gradient` (0 = none).

    most: maximum number, the splats with the largest gradients first; equal ones in the order of their rows.
    """
    mean = stats.grad2d / stats.times.clamp(min=1)
    chosen = (stats.times > 0) & (mean >= split_gradient) & (split_gradient > 0)
    if most is not None and int(chosen.sum()) > most:
        order = torch.where(chosen, mean, -1.0).sort(descending=True, stable=True).indices
        chosen[order[max(most, 0) :]] = False
    return chosen


def multiply(field: GaussianField, chosen: Tensor, config: DensifyConfig, random: np.random.Generator) -> Tensor:
    """Split the chosen splats [N] that are large; clone the others if the settings say so. Return which were split [N].

    Split splats are removed and the rows after them move up; new splats are appended. Each chosen splat enlarges the
    field by at most one.
    """
    if not chosen.any():
        return chosen
    large = chosen & (_widest(field) > config.split_scale_m)
    twins = _copies(field, chosen & ~large & config.clone)
    split(field, large, random)
    field.append(twins)
    return large


def split(field: GaussianField, chosen: Tensor, random: np.random.Generator) -> None:
    """Replace each chosen splat (bool [N]) by two smaller ones drawn from its Gaussian, appended in pairs.

    Everything except position and size is copied from the splat. Ids are new, and Adam's moments start at 0.
    """
    halves = _copies(field, chosen.nonzero().squeeze(1).repeat_interleave(2))
    _scatter(halves, random)
    field.keep(~chosen)
    field.append(halves)


def clone(field: GaussianField, rows: Tensor) -> None:
    """Append copies of some splats (bool [N] or indices), with new ids; Adam's moments start at 0."""
    field.append(_copies(field, rows))


def too_large(field: GaussianField, most_scale_m: float) -> Tensor:
    """Return which splats [N] are larger than `most_scale_m`; 0 = none."""
    if not most_scale_m:
        return torch.zeros(len(field), dtype=torch.bool, device=field.params.device)
    return _widest(field) > most_scale_m


def too_wide(
    field: GaussianField, T_camera_world: NDArray[np.float64], camera: Camera, most_radius_px: float
) -> Tensor:
    """Return which splats [N] in front of the camera, with their centres inside the image, have a radius there (3 σ)
    above `most_radius_px`."""
    T = torch.from_numpy(T_camera_world).to(field.params)
    x, y, z = (sum((field.means[:, k] * T[i, k] for k in range(3)), T[i, 3]) for i in range(3))
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
    return (z > 0) & inside & (RADIUS_SIGMAS * _widest(field) * camera.fx / z > most_radius_px)


def _widest(field: GaussianField) -> Tensor:
    """Return the largest standard deviation of each splat [N], metres; by columns, which is faster than over rows."""
    first, second, third = field.params[:, SCALES].unbind(1)
    return torch.maximum(torch.maximum(first, second), third).exp()


def _copies(field: GaussianField, rows: Tensor) -> GaussianField:
    """Return copies of rows with their attributes; Adam's moments start at 0."""
    attributes = {name: Rows(attribute.params[rows]) for name, attribute in field.attributes.items()}
    return GaussianField(field.params[rows], attributes=attributes)


def _scatter(field: GaussianField, random: np.random.Generator) -> None:
    """Move every splat to a point drawn from its own Gaussian, and make it smaller."""
    R = torch.from_numpy(se3.rotation_from_quaternion(field.quats.cpu().numpy())).to(field.params)
    drawn = field.scales * torch.from_numpy(random.standard_normal((len(field), 3))).to(field.params)
    field.params[:, MEANS] += (R * drawn[:, None, :]).sum(2)
    field.params[:, SCALES] -= float(np.log(CHILD_SCALE))
