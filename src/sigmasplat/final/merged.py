"""Read the map while it grows: the splats of one component of the atlas in one frame."""

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.component import Component
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import SubmapStore
from sigmasplat.data.trajectory import Trajectory


def merged_field(store: SubmapStore, atlas: Atlas, component: int, active: GaussianField) -> GaussianField:
    """Return the splats of all submaps of a component side by side, in its frame, in host memory; `active` are those of
    the submap that is not finished."""
    fields = (
        (store.load(s).field if s < len(store) else active.to(torch.device("cpu"))).moved(
            torch.from_numpy(atlas.anchors[s])
        )
        for s in atlas.members(component)
    )
    return GaussianField.side_by_side(fields)


def components_apart(
    store: SubmapStore, atlas: Atlas, active: GaussianField, trajectory: Trajectory, found: NDArray[np.bool_]
) -> list[Component]:
    """Return the components that are not connected to the world; trajectory: of all frames, found [F]: not lost."""
    component_of = np.array(atlas.components, np.int64)[atlas.places.submap]
    return [
        Component(n, merged_field(store, atlas, n, active), trajectory.at(found & (component_of == n)))
        for n in sorted(set(atlas.components) - {0})
    ]
