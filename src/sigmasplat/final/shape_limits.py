"""Limit the shapes of splats between fits: spikes fit a few keyframes and are wrong from everywhere else (ours)."""

from math import log

import torch

from sigmasplat.data.field import COLUMNS, GaussianField


def limit_shapes(field: GaussianField, axis_ratio: float, needle_ratio: float) -> None:
    """Limit the ratios of the axes of every splat; 0 turns a limit off.

    The longest axis becomes at most `needle_ratio` times the second longest, and the two shorter axes at least
    1/`axis_ratio` of the longest. Adam's moments of changed axes are cleared.
    """
    columns = COLUMNS["log_scales"]
    before = field.params[:, columns]
    limited = before
    if needle_ratio:
        second = before.median(1, keepdim=True).values
        limited = torch.minimum(limited, second + log(needle_ratio))
    if axis_ratio:
        longest = limited.amax(1, keepdim=True)
        limited = torch.maximum(limited, longest - log(axis_ratio))
    changed = limited != before
    for moment in (field.moment1, field.moment2):
        moment[:, columns] = moment[:, columns].masked_fill(changed, 0.0)
    field.params[:, columns] = limited
