"""Multiply splats where the loss pulls hardest, and find those that have grown too large (3DGS; CG-SLAM §5)."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import DensifyConfig
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS, GaussianField, Rows

MEANS, SCALES = COLUMNS["means"], COLUMNS["log_scales"]
CHILD_SCALE = 1.6
"""A half is smaller than the whole by this (3DGS)."""
RADIUS_SIGMAS = 3.0


@dataclass(eq=False)
class Heat:
    """How hard the loss pulled at N splats' means: the sum over steps [N], and over how many [N]. It is of one half of
    a keyframe's steps: when rows are dropped or added it means nothing any more."""

    pull: Tensor
    times: Tensor

    @staticmethod
    def of(n: int, device: torch.device | None = None) -> "Heat":
        """Start cold, on a device; by default in the host's memory."""
        return Heat(torch.zeros(n, device=device), torch.zeros(n, device=device))

    def add(self, pull: Tensor) -> None:
        """Take in one step's pulls [N] ≥ 0, 0 where a splat was not seen."""
        self.pull += pull
        self.times += pull > 0


def hot_splats(pull: Tensor, times: Tensor, split_gradient: float, most: int | None = None) -> Tensor:
    """Tell which splats were pulled at hard, bool [N]: by `split_gradient` or more, on average over the times seen.

    pull [N]: sums of pulls; split_gradient 0 = none; most: only so many, the hottest, of equals the first.
    """
    mean = pull / times.clamp(min=1)
    hot = (times > 0) & (mean >= split_gradient) & (split_gradient > 0)
    if most is not None and int(hot.sum()) > most:
        order = torch.where(hot, mean, -1.0).sort(descending=True, stable=True).indices
        hot[order[max(most, 0) :]] = False
    return hot


def multiply(field: GaussianField, hot: Tensor, config: DensifyConfig, random: np.random.Generator) -> Tensor:
    """Split the hot splats [N] that are large, clone the others where that is asked for; return which were split [N].

    Those split are gone, the rows after them move up; what is new stands at the end. A hot splat makes the field larger
    by one at most.
    """
    large = hot & (field.scales.amax(1) > config.split_scale_m)
    twins = _copies(field, hot & ~large & config.clone)
    split(field, large, random)
    field.append(twins)
    return large


def split(field: GaussianField, hot: Tensor, random: np.random.Generator) -> None:
    """Replace each hot splat (bool [N]) by two smaller ones, drawn from its Gaussian; they stand at the end, in pairs.

    All but place and size is the parent's; ids are new and Adam's state is at rest.
    """
    halves = _copies(field, hot.nonzero().squeeze(1).repeat_interleave(2))
    _scatter(halves, random)
    field.keep(~hot)
    field.append(halves)


def clone(field: GaussianField, rows: Tensor) -> None:
    """Add copies of some splats (bool [N] or indices) at the end, with new ids and Adam's state at rest."""
    field.append(_copies(field, rows))


def too_large(
    field: GaussianField,
    T_camera_world: NDArray[np.float64],
    camera: Camera,
    most_scale_m: float,
    most_radius_px: float,
) -> Tensor:
    """Tell which splats [N] are larger than `most_scale_m`, or than `most_radius_px` in the image (3 σ), 0 = off.

    In the image are those before the camera whose centres the image shows.
    """
    if not (most_scale_m > 0 or most_radius_px > 0):
        return torch.zeros(len(field), dtype=torch.bool, device=field.params.device)
    widest, T = field.scales.amax(1), torch.from_numpy(T_camera_world).to(field.params)
    large = (widest > most_scale_m) & (most_scale_m > 0)
    if most_radius_px > 0:
        x, y, z = (sum((field.means[:, k] * T[i, k] for k in range(3)), T[i, 3]) for i in range(3))
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
        large |= (z > 0) & inside & (RADIUS_SIGMAS * widest * camera.fx / z > most_radius_px)
    return large


def _copies(field: GaussianField, rows: Tensor) -> GaussianField:
    """Copy rows with what they carry besides, Adam's state at rest."""
    extras = {name: Rows(extra.params[rows]) for name, extra in field.extras.items()}
    return GaussianField(field.params[rows], extras=extras)


def _scatter(field: GaussianField, random: np.random.Generator) -> None:
    """Move every splat to a point drawn from its own Gaussian, and make it smaller."""
    R = torch.from_numpy(se3.rotation_from_quaternion(field.quats.cpu().numpy())).to(field.params)
    drawn = field.scales * torch.from_numpy(random.standard_normal((len(field), 3))).to(field.params)
    field.params[:, MEANS] += (R * drawn[:, None, :]).sum(2)
    field.params[:, SCALES] -= float(np.log(CHILD_SCALE))
