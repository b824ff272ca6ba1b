"""Measure the uncertainty of single splats against depth readings; fade uncertain ones, then prune (CG-SLAM §4)."""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.splat_sums import CHANNELS, gather
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def splat_uncertainty(
    field: GaussianField, view: View, keyframes: Sequence[Keyframe], owner: Literal["dominant", "median"]
) -> tuple[Tensor, Tensor]:
    """Return each splat's uncertainty ν [N] in m², float64, and the number of pixels n [N] used (CG-SLAM eq. 13).

    ν = Σ w (D − z)² / n over the pixels with a reading D that the splat owns, in all keyframes; z is the depth of its
    centre, w its weight. ν is 0 for a splat that owns no pixel. Renders each keyframe once; afterwards the view holds
    the last one.
    """
    spread = torch.zeros(len(field), dtype=torch.float64, device=field.params.device)
    count = torch.zeros_like(spread, dtype=torch.int64)
    for keyframe in keyframes:
        T_camera_world = se3.inverse(keyframe.T_world_camera)
        view.forward(field.params, T_camera_world, layers=True)
        rows, weights, readings = (x.to(field.params.device) for x in _owned(view, keyframe, owner))
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


def prune_by_weight(
    field: GaussianField, view: View, keyframes: Iterable[Keyframe], least_px: float, most: int
) -> None:
    """Remove the splats whose weights sum to less than `least_px` pixels in every keyframe (2DGS-SLAM: in the nearest
    one), and then those with the smallest sums until `most` are left; 0 turns either off."""
    if not least_px and not (most and len(field) > most):
        return
    weights = largest_weights(field, view, keyframes)
    keep = weights >= least_px
    if most and int(keep.sum()) > most:
        order = torch.where(keep, weights, -1.0).sort(descending=True, stable=True).indices
        keep[order[most:]] = False
    field.keep(keep)


def depths(points: Tensor, T_camera_world: Matrix) -> Tensor:
    """Return the depths [N] in m of points [N, 3] in a camera; the terms are summed in a fixed order."""
    a, b, c, d = map(float, T_camera_world[2])
    return a * points[:, 0] + b * points[:, 1] + c * points[:, 2] + d


def _owned(view: View, keyframe: Keyframe, owner: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return, for each pixel with an owner and a reading: the owner's row, its weight, the reading in m."""
    camera, layers = view.camera, view.layers
    ids, weights = {
        "dominant": (layers.dominant_id, layers.dominant_weight),
        "median": (layers.median_id, layers.median_weight),
    }[owner]
    rows, weight = (plane[: camera.height, : camera.width] for plane in (ids, weights))
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
    splat rarely owns a pixel, so its opacity decides. Within a few dozen steps the opacity cannot fall from 0.07 to
    1/255.
    """
    named = torch.zeros(field.next_id, dtype=torch.bool, device=field.ids.device)
    named[faded] = True
    faint = field.opacities < least_opacity
    return named[field.ids] & (faint | (uncertainty > uncertain_m2))
