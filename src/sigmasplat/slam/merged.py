"""Read the map while it grows: the splats of one component of the atlas in one frame."""

import torch

from sigmasplat.model.atlas import Atlas
from sigmasplat.model.field import GaussianField
from sigmasplat.model.submap import SubmapStore


def merged_field(store: SubmapStore, atlas: Atlas, component: int, active: GaussianField) -> GaussianField:
    """Return the splats of all submaps of a component side by side, in its frame, in host memory; `active` are those of
    the submap that is not finished."""
    merged = GaussianField.empty()
    for s in atlas.members(component):
        field = store.load(s).field if s < len(store) else active.to(torch.device("cpu"))
        merged.append(field.moved(torch.from_numpy(atlas.anchors[s])))
    return merged
