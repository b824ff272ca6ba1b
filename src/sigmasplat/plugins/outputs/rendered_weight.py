"""Rank splats by how much of the rendered views they make up, to export the most important ones."""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.selection import evenly_spread
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.render.backend import on_device
from sigmasplat.uncertainty.blended_values import blend_values

MOST_VIEWS = 60
"""At most this many poses of the path, evenly spread, are rendered."""


def heaviest(reader: RunReader, field: GaussianField, most: int) -> Tensor:
    """Return the mask [N] of the `most` splats with the largest rendered weight; of equal ones, the first ones.

    The rendered weight of a splat is Σ w over the pixels of a view, in the view where it is largest. A sum over all
    views would drop what few views show. Raises RunError if the run has no path.
    """
    weights = rendered_weights(reader, field)
    kept = torch.zeros(len(field), dtype=torch.bool)
    kept[torch.from_numpy(np.argsort(-weights.numpy(), kind="stable")[:most].copy())] = True
    return kept.to(field.params.device)


def rendered_weights(reader: RunReader, field: GaussianField) -> Tensor:
    """Return the rendered weight [N] of the splats in pixels of the run's working resolution (`heaviest`)."""
    camera, config = reader.camera, reader.config
    shown = on_device(field, config.backend)
    none = torch.zeros(len(field), 0)
    ones = torch.ones(camera.height, camera.width, 1)
    best = torch.zeros(len(field))
    for T_world_camera in evenly_spread(list(reader.valid_path().T_world_camera), MOST_VIEWS):
        seen = blend_values(
            shown, camera, se3.inverse(T_world_camera), none, config.render, config.backend, gather=True
        )
        best = torch.maximum(best, seen.gather(ones.to(seen.alpha))[:, 0].cpu())
    return best
