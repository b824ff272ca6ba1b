"""Change the number of splats: split and clone, find too large ones, fade and prune uncertain ones.

Splats are split and cloned where the loss has the largest gradient (3DGS; CG-SLAM §5). The uncertainty of single splats
is measured against depth readings (CG-SLAM §4).
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import DensifyConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.fit.field import DensifyStats
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.backend import CHANNELS, gather
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

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
    twins = copies(field, chosen & ~large & config.clone)
    split(field, large, random)
    field.append(twins)
    return large


def split(field: GaussianField, chosen: Tensor, random: np.random.Generator) -> None:
    """Replace each chosen splat (bool [N]) by two smaller ones drawn from its Gaussian, appended in pairs.

    Everything except position and size is copied from the splat. Ids are new, and Adam's moments start at 0.
    """
    halves = copies(field, chosen.nonzero().squeeze(1).repeat_interleave(2))
    R = torch.from_numpy(se3.rotation_from_quaternion(halves.quats.cpu().numpy())).to(halves.params)
    drawn = halves.scales * torch.from_numpy(random.standard_normal((len(halves), 3))).to(halves.params)
    halves.params[:, MEANS] += (R * drawn[:, None, :]).sum(2)
    halves.params[:, SCALES] -= float(np.log(CHILD_SCALE))
    field.keep(~chosen)
    field.append(halves)


def too_large(field: GaussianField, most_scale_m: float) -> Tensor:
    """Return which splats [N] are larger than `most_scale_m`; 0 = none."""
    if not most_scale_m:
        return torch.zeros(len(field), dtype=torch.bool, device=field.params.device)
    return _widest(field) > most_scale_m


def too_wide(field: GaussianField, T_camera_world: Matrix, camera: Camera, most_radius_px: float) -> Tensor:
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


def copies(field: GaussianField, rows: Tensor) -> GaussianField:
    """Return copies of rows with their attributes; Adam's moments start at 0."""
    attributes = {name: Rows(attribute.params[rows]) for name, attribute in field.attributes.items()}
    return GaussianField(field.params[rows], attributes=attributes)


def splat_uncertainty(field: GaussianField, view: View, keyframes: Sequence[Keyframe]) -> tuple[Tensor, Tensor]:
    """Return each splat's uncertainty ν [N] in m², float64, and the number of pixels n [N] used (CG-SLAM eq. 13).

    ν = Σ w (D − z)² / n over the pixels with a reading D that the splat dominates, in all keyframes; z is the depth of
    its centre, w its weight. ν is 0 for a splat that dominates no pixel. Renders each keyframe once; afterwards the
    view holds the last one.
    """
    spread = torch.zeros(len(field), dtype=torch.float64, device=field.params.device)
    count = torch.zeros_like(spread, dtype=torch.int64)
    for keyframe in keyframes:
        T_camera_world = se3.inverse(keyframe.T_world_camera)
        view.forward(field.params, T_camera_world, layers=True)
        rows, weights, readings = (x.to(field.params.device) for x in _dominated(view, keyframe))
        off = readings - depths(field.means.double(), T_camera_world)[rows]
        # On a device that sums in parallel, torch sorts the indices first, so that the sums are the same every time.
        spread += torch.zeros_like(spread).index_put_((rows,), weights * (off * off), accumulate=True)
        count.index_put_((rows,), torch.ones_like(rows), accumulate=True)
    return spread / count.clamp(min=1), count


def largest_weights(field: GaussianField, view: View, keyframes: Iterable[Keyframe]) -> Tensor:
    """Return the sum of each splat's blending weights over the pixels of the keyframe where it is largest [N], px."""
    largest = field.params.new_zeros(len(field))
    planes = torch.zeros(CHANNELS, view.camera.height, view.camera.width).to(view.sums)
    planes[0] = 1.0
    for keyframe in keyframes:
        view.forward(field.params, se3.inverse(keyframe.T_world_camera))
        torch.maximum(largest, gather(view, field.params, planes)[:, 0], out=largest)
    return largest


def prune_by_weight(field: GaussianField, view: View, keyframes: Iterable[Keyframe], least_px: float) -> None:
    """Remove the splats whose weights sum to less than `least_px` pixels in every keyframe (2DGS-SLAM: in the nearest
    one); 0 = none."""
    if least_px:
        field.keep(largest_weights(field, view, keyframes) >= least_px)


def depths(points: Tensor, T_camera_world: Matrix) -> Tensor:
    """Return the depths [N] in m of points [N, 3] in a camera; the terms are summed in a fixed order."""
    a, b, c, d = map(float, T_camera_world[2])
    return a * points[:, 0] + b * points[:, 1] + c * points[:, 2] + d


def _dominated(view: View, keyframe: Keyframe) -> tuple[Tensor, Tensor, Tensor]:
    """Return, for each pixel with a splat and a reading: the row of the splat with the largest weight, its weight, the
    reading in m."""
    camera, layers = view.camera, view.layers
    planes = layers.dominant_id, layers.dominant_weight
    rows, weight = (plane[: camera.height, : camera.width] for plane in planes)
    reading = keyframe.target.to(rows.device).depth_image
    judged = ((rows >= 0) & (reading > 0)).nonzero(as_tuple=True)
    return rows[judged].long(), weight[judged].double(), reading[judged].double()


def fade(field: GaussianField, rows: Tensor, opacity: float) -> Tensor:
    """Limit the opacity of some splats (bool [N] or indices) and clear Adam's moments of it; return their ids.

    Call it between fits. Without clearing, the moments would move the opacity up or down regardless of the images.
    """
    column = COLUMNS["opacity_logits"].start
    limit = float(np.log(opacity / (1.0 - opacity)))
    rows = rows.nonzero().squeeze(1) if rows.dtype == torch.bool else rows
    field.params[rows, column] = field.params[rows, column].clamp(max=limit)
    field.moment1[rows, column] = 0.0
    field.moment2[rows, column] = 0.0
    return field.ids[rows]


def still_uncertain(
    field: GaussianField, faded: Tensor, uncertainty: Tensor, uncertain_m2: float, least_opacity: float
) -> Tensor:
    """Return which faded splats [N] did not recover: still too uncertain, or opacity below `least_opacity`.

    faded: their ids; ids that no longer exist are ignored. uncertainty [N] m²: the current `splat_uncertainty`. A faded
    splat rarely owns a pixel, so its opacity decides. In a few dozen steps it cannot fall from 0.07 to 1/255.
    """
    named = torch.zeros(field.next_id, dtype=torch.bool, device=field.ids.device)
    named[faded] = True
    faint = field.opacities < least_opacity
    return named[field.ids] & (faint | (uncertainty > uncertain_m2))
